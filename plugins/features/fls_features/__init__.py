"""Features: from tracks and pings to numbers that describe each track."""
