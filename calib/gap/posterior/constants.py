"""Every constant that decides anything, with its reason. Nothing else in this folder has a threshold."""

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
