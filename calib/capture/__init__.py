"""Recordings of motion capture systems (Vicon CSV, C3D) as points of an arm, on the time of its encoders."""
