"""Whether a name pays on recordings that were not fitted: the second check, after the evidence.

Fit and choose together have the log evidence Z(fit, choose); Z(fit, choose) - Z(fit) is how well a model that saw the fit
recordings alone foretold the others. A name must foretell them better than its absence does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from calib.arrays import Mask
from calib.gap.poses.candidate import Candidate
from calib.gap.poses.evidence import Evidence
from calib.gap.static.linearised import Linearised, places
from calib.gap.static.split import Split

GAIN_LEAST = 3.0  # odds of 20 to 1 on recordings that were not fitted
SHARE_LEAST = 0.25  # of the gain that the effect should bring there, where that is less

Weigh = Callable[[Mask], Evidence]


def refuted(
    around: Linearised, tried: Sequence[Candidate], chosen: Sequence[int], parts: Split
) -> tuple[int, ...]:
    """Of the chosen candidates those that the choose recordings could show, and do not bear out."""
    if not chosen or not parts.is_divided or not parts.choose.any():
        return ()
    some = [tried[k] for k in chosen]
    fit, known = (around.evidence(some, rows) for rows in (parts.fit, parts.known))
    at = places(some)
    return tuple(k for k, own in zip(chosen, at, strict=True) if _gain(fit, known, at, own) < 0.0)


def _gain(fit: Evidence, known: Evidence, at: Sequence[Sequence[int]], own: Sequence[int]) -> float:
    """What the columns `own` gain on the choose recordings beyond what they must, all others beside them."""
    beside = [place for one in at if one != own for place in one]
    whole = [place for one in at for place in one]
    gain = known.log(whole) - known.log(beside) - (fit.log(whole) - fit.log(beside))
    value = known.estimate(whole)[0][[whole.index(place) for place in own]]
    seen = [one.detectability(own, value, beside) ** 2 for one in (known, fit)]
    expected = 0.5 * max(0.0, seen[0] - seen[1])
    return float(gain - min(GAIN_LEAST, SHARE_LEAST * expected)) if np.isfinite(gain) else -np.inf
