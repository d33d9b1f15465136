"""The run directory: files, checkpoints, metrics, trackers."""
