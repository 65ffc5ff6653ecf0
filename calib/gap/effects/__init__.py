"""The effects as the gap workflow looks for them, one file a family: a record each, for poses and for time series."""
