"""Drills: one named fault on a mock arm, and what the arm did, measured from the plant's truth."""
