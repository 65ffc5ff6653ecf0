"""Distances as observations of an arm: draw wires, dial gauges, ball bars, and distances between two poses of the tip."""
