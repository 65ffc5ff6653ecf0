"""Forward and inverse kinematics: generated straight-line code and closed forms."""
