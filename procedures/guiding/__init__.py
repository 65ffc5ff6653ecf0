"""Motions that a hand has shown: another arm follows them, or the arm repeats them."""
