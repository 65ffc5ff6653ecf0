"""Poses of a printed target from pictures: the lens of a camera, the target's pose, and how uncertain both are."""
