"""Sources: simulated scenes, recordings and files of detections."""
