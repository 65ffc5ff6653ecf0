"""points.csv: reading, writing, and the table whose cavities the points are."""
