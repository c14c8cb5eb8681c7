"""Classifiers: from features to classes."""
