"""Rows of residuals over their noise, what stands beside every row, and how rows respond to laws."""
