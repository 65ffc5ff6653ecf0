"""Time series of an arm as a model of what drives them: recordings, physics, terms."""
