"""Seeing what an arm did or does: figures of a recording, the arm in a 3-D scene, a stream to other viewers."""
