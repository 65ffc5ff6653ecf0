"""Poses of calibration boards: markers, registration, outliers."""
