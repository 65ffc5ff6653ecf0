"""Residuals of a model as rows over their noise floor, and which sizes of an effect are worth a name."""
