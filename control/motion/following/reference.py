"""The reference posture: smooth joint angles over time through known poses, to which redundant joints stay near."""

from collections.abc import Sequence

import numpy as np

from control.motion.samples import Array
from control.motion.timing import continuous_velocities


class ReferencePosture:
    """Cubics through poses (k + 1, n) at `times_s`, acceleration continuous, at rest at both ends."""

    def __init__(self, times_s: Sequence[float], poses: Sequence[Sequence[float]]) -> None:
        rest = (0.0,) * len(poses[0])
        steps = np.diff(times_s).tolist()
        velocity = np.array(continuous_velocities(poses, steps, rest, rest))
        h, q = np.diff(times_s)[:, None], np.array(poses, dtype=np.float64)
        slope = np.diff(q, axis=0) / h
        self._times_s = np.asarray(times_s, dtype=np.float64)
        self._c0, self._c1 = q[:-1], velocity[:-1]
        self._c2 = (3.0 * slope - 2.0 * velocity[:-1] - velocity[1:]) / h
        self._c3 = (velocity[:-1] + velocity[1:] - 2.0 * slope) / h**2

    def at(self, times_s: Array) -> tuple[Array, Array, Array]:
        """Angles, speeds and accelerations (m, n) at times (m,)."""
        section = np.clip(np.searchsorted(self._times_s, times_s, "right") - 1, 0, len(self._c0) - 1)
        t = (times_s - self._times_s[section])[:, None]
        c1, c2, c3 = self._c1[section], self._c2[section], self._c3[section]
        return (
            self._c0[section] + t * (c1 + t * (c2 + t * c3)),
            c1 + t * (2.0 * c2 + 3.0 * t * c3),
            2.0 * c2 + 6.0 * t * c3,
        )
