"""The criteria of ISO 9283 as formulas, one file each."""
