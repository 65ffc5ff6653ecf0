"""Whether a shape without a name would do as well as a name: then the name is a guess, however well it fits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.gap.static.candidate import Candidate
from calib.gap.static.evidence import Evidence
from calib.gap.static.shape import Shape

LEAD = 3.0  # log evidence, 20 to 1, by which a name must lead every shape
WIDER = 2.0  # by which a shape must lead a name, for every column that it has more
WIDER_MOST = 6.0
SAME = 0.9999  # cosine between the signatures of a shape and of an effect of the list, from which on they are one


def doubles(
    evidence: Evidence,
    at: Sequence[Sequence[int]],
    shapes_at: Sequence[Sequence[int]],
    tried: Sequence[Candidate],
    chosen: Sequence[int],
    shapes: Sequence[Shape],
) -> dict[int, Shape]:
    """Of the chosen candidates those that a shape could replace with hardly a loss, each with the best such shape.

    `evidence` holds the columns of all candidates (`at`) and shapes (`shapes_at`). A shape that is an effect of the list in
    other words is no rival: that effect is one already. One with more columns may contain the effect, and must itself lead.
    """
    found = {}
    own = _same_as_an_effect(evidence, at, shapes_at)
    for k in chosen:
        beside = [place for other in chosen if other != k for place in at[other]]
        named = evidence.log([*beside, *at[k]])
        rivals = [
            (evidence.log([*beside, *places]) - _must_lead(len(places) - len(at[k])), number)
            for number, places in enumerate(shapes_at)
            if number not in own
        ]
        best, number = max(rivals, default=(-np.inf, 0))
        if best >= named:
            found[k] = shapes[number]
    return found


def _must_lead(more: int) -> float:
    """Log evidence by which a shape with `more` columns than a name must lead it to replace it; below 0 it may lag."""
    return -LEAD if more <= 0 else min(WIDER * more, WIDER_MOST)


def _same_as_an_effect(
    evidence: Evidence, at: Sequence[Sequence[int]], shapes_at: Sequence[Sequence[int]]
) -> set[int]:
    """Shapes whose signature the columns of one effect take up nearly wholly, the geometry refitted."""
    places = [place for shape in shapes_at for place in shape]
    begins = np.cumsum([0, *(len(shape) for shape in shapes_at)])[:-1]
    total = np.add.reduceat(np.diag(evidence.gram)[places], begins)
    same = total <= 0.0
    for effect in at:
        inner, cross = evidence.gram[np.ix_(effect, effect)], evidence.gram[np.ix_(effect, places)]
        taken = np.einsum("es,es->s", cross, np.linalg.lstsq(inner, cross, rcond=1e-10)[0])
        same |= np.add.reduceat(taken, begins) > SAME**2 * total
    return set(np.flatnonzero(same).tolist())
