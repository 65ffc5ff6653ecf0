"""One posterior over sets of effects: names what a real arm lacks although no real law is exact and many effects act at once.

It knows columns, their Gram matrix and priors, nothing of poses or time series: those are calib.gap.poses and calib.gap.series.
"""
