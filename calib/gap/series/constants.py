"""Every constant of time series that decides anything, with its reason, beside those of calib.gap.posterior.constants."""

from __future__ import annotations

from typing import Final

# The usual size of an effect, in smallest sizes worth a name (calib.gap.residuals.sizes): these are what a careful builder would
# still correct, and what is met is about ten times that. Of the frictions that every gear has, much more.
USUAL: Final = 10.0
USUAL_OF: Final = {"coulomb_friction": 20.0, "viscous_friction": 20.0}
# Prior probability of Coulomb and viscous friction where the arm's file has neither: there is no gear without.
COMMON_PRIOR: Final = 0.97
# Of the smallest size worth a name, one standard deviation: to this the nominal values of everything are known.
IMMATERIAL: Final = 0.4
# Standard deviations of it that may be taken off as known: beyond, it is something that has to be found.
ALWAYS_MOST: Final = 3.0
# Of a start of a law that bends: between these its secant speaks for the law; beyond, another start's does.
SPEAKS_FOR: Final = (0.4, 2.2)
# Of a law, by which a departure must differ from it: less cannot be told from another size.
BENDS_LEAST: Final = 0.03
# Order of the autoregressive noise: at 60 rows a second a tenth of a second, the reach of the filters.
ORDER: Final = 6
# Rows that the mean of all runs counts for in the noise of one run.
DRAWN: Final = 20
# Of the floor, below which prediction errors are a fit to too few rows.
NOISE_LEAST: Final = 0.8
# Times the floor: what the first look leaves above it is noise that nobody has measured yet.
UNTOLD: Final = 1.05
# Standard deviations of a name's coefficient from nothing.
SURE_sd: Final = 3.0
# Of the squared gap on runs kept apart, by which it may grow with a name: noise makes it grow by less.
GROWS: Final = 0.02
# Of a link's mass or inertia in the file, that may be missing: more is no link.
MISSING_MOST: Final = 0.5
# Of what a name does to the runs that were fitted, mean squares: with less on the runs kept apart these do not speak of it.
SPEAKS: Final = 0.1
# Of a cell's variance at the floor, on runs kept apart: what a remainder must explain there to be worth a word.
REMAINS: Final = 0.1
# Times the floor: what is above it without any block is said, too.
SILENT_MOST: Final = 2.0
