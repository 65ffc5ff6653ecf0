"""Design of experiments: which points, tilts and free poses to record next, and the gain of each."""
