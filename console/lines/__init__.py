"""Operator lines: what a script says line by line, and what is typed into the console's command box."""
