"""One posterior over sets of effects for time series: what the motion of a real arm lacks, many effects at once.

Not in use yet: `armwright gap` still decides by calib.gap.dynamic. `python -m benchmarks.gap.dynamic.series_score` sets both
engines on the same cases.
"""
