"""The arm's boards as the loop sees them: one Protocol, the real boards behind it, and angles from counts."""
