"""What decides, in poses and in time series: every threshold with its unit and its reason.

Elsewhere stand how recordings are split (`GROUPS_LEAST`, `FREEDOM_LEAST`, `REPORT_SHARE`), the effort of the
search (`search.py`), the sizes and shapes of effects and blocks (their records), what measurements are like (`poses/floor.py`,
`signals/`), and what is refused or warned of as misread.
"""

from __future__ import annotations

import math
from statistics import NormalDist
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
# The same of the usual part: of laws that the file has, and of what other recordings tell.
ROUGH: Final = DEPARTURES[2]
# Size of a nameless block beside 3 mrad or 1 mm, evenly weighted: nobody knows it.
BLOCK_LEVELS: Final = (0.1, 0.3, 1.0, 3.0)
# Posterior inclusion from which on a name is given, a set called ambiguous, and a remainder claimed.
CERTAIN: Final = 0.95
# Log evidence by which a name must lead another in its place: what parts two that may stand for each other is mostly how many
# ways to depart each was given. A variant or size of an effect that lies further behind no longer counts in its parameters.
MARGIN: Final = 5.0
# Standard deviations by which a coefficient, a gain of maps, or one of two estimates of a value must differ from nothing, from
# the arm's file or from the other, to be worth saying: among some hundred that are looked at none may do so by chance. So many of
# what is never known better may be taken off as known, too; beyond, it is something that has to be found.
SURE_sd: Final = 3.0
# The same of what is looked at once, such as a value whose interval of that probability may hold nought.
CHECKED_sd: Final = NormalDist().inv_cdf(0.5 * (1.0 + CERTAIN))
# Share by which two estimates of the same thing may differ.
AGREE: Final = 0.2
# Probability, or share of all weight, below which a member of a set, or a size, is no candidate of anybody's.
CREDIBLE_LEAST: Final = 0.005
# Material: of a cell's variance at the floor, what a remainder must explain on runs kept apart to be worth a word; of what a name
# does to the runs that were fitted, what it must do to those kept apart for them to speak of it; of what a name adds to the log
# evidence, what a rival may lack at the name's own operating point and be looked at at its own.
REMAINS: Final = 0.1
# Times what else there is, above which something material is left that nothing has told yet.
UNTOLD: Final = math.sqrt(1.0 + REMAINS)
# Times the floor: up to the first a gap counts as closed; from the second on what the list leaves is worth a word, and silence of
# a recording says nothing; above the third it is said even where no block takes it (three quarters of it, squared, are no noise).
AT_FLOOR: Final = 1.1
INFLATED: Final = 1.3
SILENT_MOST: Final = 2.0
# Share of what is left: an effect that explains less is not near.
NEAR: Final = 0.05
# Standard deviation of the noise floor's logarithm, where nothing measured it better: a data sheet is right to this.
FLOOR_DOUBT: Final = 0.03
# Friction that winds up a soft gear, as a share of what the motor holds: half of it, give or take as much.
WOUND_SHARE: Final = 0.5
# Of its size level: how large a law must be for departures from it to be its own, and no law of another kind.
LAW_LEAST: Final = 0.3
# A law that departs more than two standard deviations of the roughest part is another law.
LAW_MOST: Final = 2.0 * max(DEPARTURES)
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

# Of poses alone

# Times the scatter of the others, from which a pose is an outlier; and the share of poses above which they are another arm.
FAR: Final = 7.0
OUTLIERS_MOST: Final = 0.05
# Of the poses, that must lie on a known flank of a play: else a play fits anything.
CLEAR_SHARE: Final = 0.5

# Of maps alone

# Of the mean square of recordings that were not fitted: a correction that gains less is not worth it, and one that gains more
# than the second needs no counting (it may stand in the few pieces that are fast, or heavily loaded).
PAYS: Final = 0.05
LARGE: Final = 0.25

# Of time series alone

# The usual size of an effect, in smallest sizes worth a name (calib.gap.signals.terms): these are what a careful builder would
# still correct, and what is met is about ten times that.
USUAL: Final = 10.0
# Prior probability of Coulomb and viscous friction where the arm's file has neither: there is no gear without.
COMMON_PRIOR: Final = 0.97
# Of the smallest size worth a name, one standard deviation: to this the nominal values of everything are known.
IMMATERIAL: Final = 0.4
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
# Of the squared gap on runs kept apart, by which it may grow with a name: noise makes it grow by less.
GROWS: Final = 0.02
# Of a link's mass or inertia in the file, that may be missing: more is no link.
MISSING_MOST: Final = 0.5
