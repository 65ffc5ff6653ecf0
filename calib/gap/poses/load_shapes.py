"""Whether a load that holding currents name leaves something in them: then it is another load, or more than one.

Any two loads look like a third in some poses (a payload is a heavier forearm and a lighter upper arm), so that at most one is
named, and only if no joint's torque follows an angle beyond it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from calib.arrays import Array, Mask
from calib.gap.poses.candidate import Candidate
from calib.gap.poses.currents import Currents

LEAD = 3.0  # log evidence by which a mass must lead a joint's load in proportion
SHARE = 0.1  # typical
CLEAR = 6.0  # log evidence of a shape beside the name: some thirty are tried


def contradiction(
    currents: Currents | None, told: Sequence[Candidate], q_rad: Array, rows: Mask
) -> str | None:
    """In words, what the currents show beyond the candidates `told`; None if nothing, or if there is nothing to check."""
    if currents is None or not told:
        return None
    shapes = list(_shapes(currents, q_rad))
    columns = [one.slope_Nm * one.size[:, None, None] for one in told if one.slope_Nm is not None]
    evidence = currents.evidence_of(np.concatenate((*columns, *(moved for _, moved in shapes))), rows)
    named = list(range(sum(len(column) for column in columns)))
    alone, first = evidence.log(named), len(named)
    best, words = CLEAR, None
    for text, moved in shapes:
        paid = evidence.log([*named, *range(first, first + len(moved))]) - alone
        first += len(moved)
        if paid > best:
            best, words = paid, text
    return words or _in_proportion(currents, told, rows)


def _in_proportion(currents: Currents, told: Sequence[Candidate], rows: Mask) -> str | None:
    """Whether the torque of one joint alone, in proportion to its load, would do as well as a mass."""
    if any(one.name.effect == "torque_constant" for one in told):
        return None
    columns = [one.slope_Nm * one.size[:, None, None] for one in told if one.slope_Nm is not None]
    n = currents.gravity_Nm.shape[1]
    loads = np.stack([SHARE * currents.gravity_Nm * np.eye(n)[j] for j in range(n)])
    evidence = currents.evidence_of(np.concatenate((*columns, loads)), rows)
    named = evidence.log(range(len(evidence.pull) - n))
    for j in range(n):
        if evidence.log([len(evidence.pull) - n + j]) >= named - LEAD:
            return f"the holding current of joint {j + 1} is off in proportion to its load"
    return None


def _shapes(currents: Currents, q_rad: Array) -> Iterator[tuple[str, Array]]:
    """The torque of one joint with the sine and cosine of any angle and of sums of two, (2, m, n)."""
    m, n = q_rad.shape
    angles = [(f"q{i + 1}", q_rad[:, i]) for i in range(n)]
    angles += [(f"q{i + 1} + q{k + 1}", q_rad[:, i] + q_rad[:, k]) for i, k in combinations(range(n), 2)]
    for j in range(n):
        size = float(np.abs(currents.torque_Nm[:, j]).max())
        for name, angle in angles if size > 0.0 else ():
            moved = np.zeros((2, m, n))
            moved[0, :, j], moved[1, :, j] = size * np.sin(angle), size * np.cos(angle)
            yield (
                f"the holding current of joint {j + 1} follows {name} in a way that no single load explains",
                moved,
            )
