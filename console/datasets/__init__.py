"""Recordings as data sets for learning."""
