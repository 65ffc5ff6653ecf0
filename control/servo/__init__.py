"""Controllers of a joint: PID, feed-forward to volts, gravity compensation."""
