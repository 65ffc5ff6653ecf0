"""Recording what the gap workflow needs, on an arm or its mock."""
