"""Identification: the deviations that best explain the measured tips, with their uncertainty."""
