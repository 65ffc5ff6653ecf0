"""Streams of motion capture systems: Vicon Tracker, OptiTrack (NatNet), Qualisys (QTM RT). docs/motion_capture.md."""
