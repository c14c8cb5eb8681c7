"""Longer work around graphs: parameter sweeps."""
