"""What decides, in poses and in time series: every threshold with its unit and its reason.

Elsewhere stand the effort of the search (`search.py`: how many sets are tried), the sizes and shapes of effects and blocks (their
records), what measurements are like (`poses/floor.py`, `currents.py`), and when a sentence is worth saying (`poses/cautions.py`).
"""

from __future__ import annotations

from typing import Final

# Prior probability of one effect on one joint: of some 25 that an arm of three joints can show, about one in three arms has one.
NAME_PRIOR: Final = 0.015
# Prior probability of one nameless block: there are twice as many, and the list was made because its names are the common ones.
BLOCK_PRIOR: Final = 0.0002
# How large an effect is beside the usual size, with weights: a mixture, because sizes spread over a decade.
SIZE_LEVELS: Final = (0.4, 1.0, 2.5, 6.0)
SIZE_WEIGHTS: Final = (0.3, 0.4, 0.2, 0.1)
# How far a real part departs from the textbook's law, as a share of its size, with weights.
DEPARTURES: Final = (0.0, 0.03, 0.06, 0.12)
DEPARTURE_WEIGHTS: Final = (0.35, 0.3, 0.2, 0.15)
# Size of a nameless block beside 3 mrad or 1 mm, evenly weighted: nobody knows it.
BLOCK_LEVELS: Final = (0.1, 0.3, 1.0, 3.0)
# Posterior inclusion from which on a name is given, a set called ambiguous, and a remainder claimed.
CERTAIN: Final = 0.95
# Log evidence by which a name must lead one that an effect of usual size cannot be told from: what parts their forms of one law
# is then mostly how many ways to depart each was given.
MARGIN: Final = 5.0
# Of what a name adds to the log evidence: what a rival may lack at the name's own operating point, and be looked at at its own.
NEARLY: Final = 0.1
# Standard deviation of the noise floor's logarithm, where nothing measured it better: a data sheet is right to this.
FLOOR_DOUBT: Final = 0.03
# Friction that winds up a soft gear, as a share of what the motor holds: half of it, give or take as much.
WOUND_SHARE: Final = 0.5
# Of its size level: how large a law must be for departures from it to be its own, and no law of another kind.
LAW_LEAST: Final = 0.3
# Standard deviations by which a coefficient must differ from nothing, or from the arm's file, to be worth saying.
CHANGED_sd: Final = 3.0
# Chi-square beyond its count that a refitted geometry must gain before the nominal one is called wrong.
GEOMETRY_PAYS: Final = 40.0
# A law that departs more than two standard deviations of the roughest part is another law.
LAW_MOST: Final = 2.0 * max(DEPARTURES)
# Probability that a further member of a set of "one of these" must add: less is no candidate of anybody's.
CREDIBLE_LEAST: Final = 0.005
# Log evidence below the best at which a variant or size of an effect no longer counts in its parameters.
NEGLIGIBLE: Final = 5.0
# Standard deviations of all rows together, by which a step of a linearisation moves them at most when values have settled: half
# in log evidence.
SETTLED_sd: Final = 1.0
# Log evidence that an unknown size costs an effect which just stands out.
SIZE_COST: Final = 1.5
# Noise adds one standard deviation to how far an effect stands out: enough standard deviations in 97 of 100 recordings.
MOSTLY_sd: Final = 1.88
# Doubt of a noise floor that nothing measured, as FLOOR_DOUBT: anything from a third to three times.
UNMEASURED: Final = 1.0
# Parts in which recordings are left out in turn: each is predicted from four fifths of the others.
FOLDS: Final = 5
# Cosine of two shapes from which on they are one: what a block could then show is the effect that it looks like.
SAME: Final = 0.999

# Of time series alone

# The usual size of an effect, in smallest sizes worth a name (calib.gap.signals.terms): these are what a careful builder would
# still correct, and what is met is about ten times that.
USUAL: Final = 10.0
# Prior probability of Coulomb and viscous friction where the arm's file has neither: there is no gear without.
COMMON_PRIOR: Final = 0.97
# Of the smallest size worth a name, one standard deviation: to this the nominal values of everything are known.
IMMATERIAL: Final = 0.4
# Standard deviations of it that may be taken off as known: beyond, it is something that has to be found.
NUISANCE_MOST: Final = 3.0
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
