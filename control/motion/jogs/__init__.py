"""Jogs: set-points that follow what somebody holds down, of joints, of the tip, of the tip with its orientation."""
