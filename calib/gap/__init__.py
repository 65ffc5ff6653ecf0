"""The gap workflow: where simulation and measurement disagree, what is missing, and what the data cannot tell."""
