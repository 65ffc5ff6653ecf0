"""What changes between calibrations: a record of them, what drifts and how fast, and when the next one is due."""
