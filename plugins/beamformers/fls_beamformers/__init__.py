"""Beamformers: from hydrophone samples to pings."""
