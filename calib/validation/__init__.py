"""Validation of a calibration: held-out points, before against after, and the verdict."""
