"""How a task is done with the least expected tip error: where, on which branch, which way round, from which side, how fast."""
