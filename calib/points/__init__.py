"""points.csv: reading and writing."""
