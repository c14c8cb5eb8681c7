"""Detectors of Acme Sonar."""
