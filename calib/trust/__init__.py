"""How far an arm can be trusted: the tip's predicted error with intervals, and what follows from it."""
