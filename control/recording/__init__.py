"""Every cycle on disk, and what other programs read of it: CSV and MCAP."""
