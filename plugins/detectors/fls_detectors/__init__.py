"""Detectors: from pings to detections, noisy beams and wakes."""
