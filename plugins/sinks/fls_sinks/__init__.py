"""Sinks: files and pictures of what a graph finds."""
