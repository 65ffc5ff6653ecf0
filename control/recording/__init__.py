"""Recording of every cycle, and its export to CSV and MCAP."""
