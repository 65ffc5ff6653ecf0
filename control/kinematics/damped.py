"""Joint rates for a rate of the tip that stay small at singular poses: damped least squares, for jogging only.

Near a singular pose the weak directions get s / (s^2 + d^2) instead of 1 / s, with d growing from 0 at SAFE_M to MOST_M at the
singular pose itself (Siciliano et al., Robotics, 3.5.2). The tip then lags behind what was asked for.
"""

import numpy as np
from numpy.typing import NDArray

from control.kinematics.pose_solver import TURN_LENGTH_M, Task

Array = NDArray[np.float64]
SAFE_M = 0.04  # m/rad: twice what a path may come down to
MOST_M = 0.03  # m/rad: at 0.1 m/s no joint passes 1.7 rad/s
_NEARLY_M = 1e-3  # of rows that are held as nearly as possible
_SCALE = np.array([1.0] * 3 + [TURN_LENGTH_M] * 3)


class DampedRates:
    """The joints' answer to rates of the tip in one pose."""

    def __init__(self, task: Task, jacobian: Array) -> None:
        """`jacobian`: (6, n)."""
        self._task = task
        rows = jacobian * _SCALE[:, None]
        exact = rows[list(task.exact)]
        self._nearest = rows[list(task.nearest)]
        u, s, vt = np.linalg.svd(exact) if task.exact else (np.eye(0), np.empty(0), np.eye(rows.shape[1]))
        self.margin_m = (
            float(s[-1])
            if task.exact
            else float(np.linalg.svd(self._nearest, compute_uv=False)[task.rank - 1])
        )
        weakness = max(0.0, 1.0 - (self.margin_m / SAFE_M) ** 2)
        gain = s / (s * s + MOST_M**2 * weakness) if s.size else s
        self._inverse = vt[: len(s)].T @ (gain[:, None] * u.T)
        self._directions, self._shares = u, gain * s
        self._free = vt[len(s) :].T
        self.is_damped = weakness > 0.0

    def share(self, tip: Array) -> float:
        """How much of six rates of the tip the joints still give, of what they hold exactly: 1 far from singular poses."""
        along = self._directions.T @ (tip * _SCALE)[list(self._task.exact)]
        size = float(along @ along)
        return float(self._shares @ along**2) / size if size else 1.0

    def rates(self, tip: Array) -> Array:
        """Joint rates (n,) for six rates of the tip, of the least size."""
        scaled = tip * _SCALE
        held = self._inverse @ scaled[list(self._task.exact)]
        if not self._task.nearest or not self._free.size:
            return np.asarray(held)
        slope = self._nearest @ self._free
        missing = scaled[list(self._task.nearest)] - self._nearest @ held
        damped = slope.T @ slope + _NEARLY_M**2 * np.eye(slope.shape[1])
        return np.asarray(held + self._free @ np.linalg.solve(damped, slope.T @ missing))
