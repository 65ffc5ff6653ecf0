"""The whole calibration: from points to a validated result and a calibrated arm."""
