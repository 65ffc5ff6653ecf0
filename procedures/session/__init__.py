"""The operator's side of a calibration session: commands in, text out."""
