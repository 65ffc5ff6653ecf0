"""One posterior over sets of effects for time series: what the motion of a real arm lacks, many effects at once."""
