"""Journeys of a user through several parts of armwright; `runner.py` walks them."""
