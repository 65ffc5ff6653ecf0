"""Recording for the gap workflow, on an arm or its mock."""
