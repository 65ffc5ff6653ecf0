"""Two arms whose tips touch: parameters of both, and where they stand to each other, from joint angles alone."""
