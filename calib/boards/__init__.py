"""Where calibration boards stand: markers, registration, outliers."""
