"""One posterior over sets of effects: what a real arm lacks, its laws only roughly right, many effects at once.

Not in use yet: `armwright gap` still decides by calib.gap.static. `python -m benchmarks.gap.static.posterior_score` sets both
engines on the same cases.
"""
