"""Operator lines: the lines of a script and of the console's command box."""
