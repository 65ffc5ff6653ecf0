"""A calibration from end to end: points in, a judged result and a calibrated arm out."""
