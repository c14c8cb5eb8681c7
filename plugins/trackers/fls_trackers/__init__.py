"""Trackers: from detections to tracks."""
