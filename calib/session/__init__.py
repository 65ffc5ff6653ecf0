"""A calibration session: recording at a point, order of the points, saved data.

plan: planned and recorded targets, without I/O; folder: the same on disk; conduct: the dialogue between operator, arm and
folder; sequence: the same without an operator.
"""
