"""`armwright tune`: a joint's response is measured, gains are designed on it, and both are tried on the arm, before and after."""
