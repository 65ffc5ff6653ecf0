"""Tools that are joined rigidly: the orientation of the second in the first is the same at all contacts of one join.

    e = lever log(R_base R_2 (R_1 exp([t]) R_0)'),   R_0: the join's start, t: its unknown turn
    de = lever (J_l(e)^-1 w_2 - J_r(e)^-1 w_1)       (Barfoot, State Estimation for Robotics, 7.1)

w: how the last links turn with the unknowns, in the base frame. A link's theta turns it about the axis along which its d moves
the tip, its alpha about that of its L.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arm_problem.frames import left_jacobian, mean_rotation, rotation_of
from calib.arm_problem.posed import inverse_jacobians
from calib.arrays import Array
from control.kinematics.chain_jacobian import TipSlopes
from control.kinematics.rotation import logarithms

LEVER_m = 0.1  # makes an angle a length: 0.2 mm at a tip are 2 mrad between tools
D, THETA, L, ALPHA = range(4)  # of a DH row


@dataclass(frozen=True, slots=True)
class Joins:
    """The contacts `rows` (r,) of joined tools, which of the `names` each belongs to (r,), and each join's start (j, 3, 3)."""

    names: tuple[str, ...]
    rows: npt.NDArray[np.intp]
    which: npt.NDArray[np.intp]
    start: Array

    @classmethod
    def of(cls, joined: Sequence[str], first: Array, second: Array) -> Joins:
        """Of the names of all contacts ("": not joined), and the last links' rotations (m, 3, 3) by nominal arms."""
        names = tuple(sorted({name for name in joined if name}))
        rows = np.array([row for row, name in enumerate(joined) if name], dtype=np.intp)
        which = np.array([names.index(joined[row]) for row in rows], dtype=np.intp)
        apart = np.swapaxes(first[rows], 1, 2) @ second[rows]
        start = [mean_rotation(apart[which == k]) for k in range(len(names))]
        return cls(names, rows, which, np.array(start).reshape(-1, 3, 3))

    def __len__(self) -> int:
        """How many contacts."""
        return len(self.rows)

    def errors(self, turns: Array, first: Array, second: Array) -> Array:
        """Angles between the tools, against their join's (r, 3) [rad]; `turns` (j, 3), rotations (r, 3, 3) of the last links."""
        wanted = np.array([rotation_of(turn) for turn in turns]).reshape(-1, 3, 3) @ self.start
        return logarithms(second @ np.swapaxes(first @ wanted[self.which], 1, 2))

    def slopes(self, errors: Array, by_first: Array, by_second: Array, at_zero: bool) -> Array:
        """Derivatives (r, 3, k) of LEVER_m * errors, from how both links turn (r, 3, k); `at_zero`: as if the errors were 0."""
        if not at_zero:
            inverse = inverse_jacobians(errors)
            by_second = inverse @ by_second
            by_first = np.swapaxes(inverse, 1, 2) @ by_first  # J_r(e) = J_l(e)'
        return np.asarray(LEVER_m * (by_second - by_first))

    def by_turn(self, turns: Array, first: Array, out: Array) -> None:
        """Write how the first link turns with each join's t to `out` (r, 3, 3 j)."""
        for k, turn in enumerate(turns):
            mine = self.which == k
            out[mine, :, 3 * k : 3 * k + 3] = first[mine] @ left_jacobian(turn)


def turning(slopes: TipSlopes) -> Array:
    """How the last link turns with dh.ravel(), (m, 3, 4 links)."""
    found = np.zeros(slopes.by_dh.shape)
    found[:, :, THETA::4] = slopes.by_dh[:, :, D::4]
    found[:, :, ALPHA::4] = slopes.by_dh[:, :, L::4]
    return found
