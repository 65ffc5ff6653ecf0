"""Whether a shape without a name would do as well as a name: then the name is a guess, however well it fits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.gap.poses.candidate import Candidate
from calib.gap.poses.evidence import Evidence, tail
from calib.gap.poses.shape import Shape

LEAD = 3.0  # log odds, 20 to 1, that a name must have over all shapes together
LISTED = 3.0  # prior odds that what moves a joint is in the list, to that it is not
WIDER = 2.0  # by which a shape must lead a name, for every column that it has more
WIDER_MOST = 6.0
SAME = 0.9999  # cosine between the signatures of a shape and of an effect of the list, from which on they are one


def confounders(
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
    others = [number for number in range(len(shapes_at)) if number not in own]
    for k in chosen:
        beside = [place for other in chosen if other != k for place in at[other]]
        named, *instead = _logs(evidence, beside, [at[k], *(shapes_at[number] for number in others)])
        prior = _prior(len({one.name for one in tried}), len(others))
        leads = [
            (
                log - named + prior * shapes[number].is_common,
                len(shapes_at[number]) - len(at[k]),
                number,
            )
            for number, log in zip(others, instead, strict=True)
        ]
        number = _best_double(leads, prior)
        if number is not None:
            found[k] = shapes[number]
    return found


def _logs(evidence: Evidence, beside: Sequence[int], sets: Sequence[Sequence[int]]) -> list[float]:
    """Log evidence of each set with what stands beside it; what is large is given back no more than it has alone."""
    logs, values = evidence.log_each([[*beside, *one] for one in sets])
    _, alone = evidence.log_each(sets)
    back = [
        min(tail(value[len(beside) :]), tail(single)) for value, single in zip(values, alone, strict=True)
    ]
    return [float(log) + more for log, more in zip(logs, back, strict=True)]


def _best_double(leads: Sequence[tuple[float, int, int]], prior: float) -> int | None:
    """The shape that stands for a name, of (log evidence beyond the name's, columns more, number) each; None if none may."""
    wider = [(lead - min(WIDER * more, WIDER_MOST), number) for lead, more, number in leads if more > 0]
    best, number = max(wider, default=(-np.inf, 0))
    if best >= 0.0:
        return number
    alike = [(lead, number) for lead, more, number in leads if more <= 0]
    if not alike or prior - float(np.logaddexp.reduce([lead for lead, _ in alike])) >= LEAD:
        return None
    return max(alike)[1]


def _prior(names_count: int, shapes_count: int) -> float:
    """Log prior odds of one name to one shape: each side's chance is spread evenly over what it has."""
    return float(np.log(LISTED * max(1, shapes_count) / max(1, names_count)))


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
