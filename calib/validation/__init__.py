"""What a calibration is worth: held-out points, before against after, and the verdict."""
