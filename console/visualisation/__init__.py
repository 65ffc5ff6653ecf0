"""Visualisation of recordings and of the live arm: figures of a recording, the arm in a 3-D scene, a stream to other viewers."""
