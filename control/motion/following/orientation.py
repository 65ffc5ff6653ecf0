"""The tip's orientation along a path: in each section the rotation vector from its start is a cubic over time.

    R(t) = R_i exp(r(t)),   r(t) = c1 t + c2 t^2 + c3 t^3     (the cubic of SpringerPlus 5:1771, eq. (3), with a0 = 0)

Between two way-points, from rest to rest, this is slerp with the cubic's timing. The angular velocity is continuous: at an inner
way-point it is that of the parabola through the neighbouring turns, and zero where the path rests.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from control.kinematics import rotation as rotations
from control.kinematics.rotation import Quaternion
from control.motion.samples import Array, TurnSamples

_DIFFERENCE = 1e-4  # of a section's time, for the angular acceleration: 1e-8 relative


def turns_rad(orientations: Sequence[Quaternion]) -> tuple[float, ...]:
    """Angle [rad] between each orientation and the next, at most half a turn."""
    return tuple(float(np.linalg.norm(rotations.between(a, b))) for a, b in pairwise(orientations))


class OrientationSpline:
    """Orientations at `times_s` (k + 1), and all between them. `rests` (k + 1): where the tip does not turn."""

    def __init__(
        self, times_s: Sequence[float], orientations: Sequence[Quaternion], rests: Sequence[bool]
    ) -> None:
        at = rotations.matrices(np.array(orientations, dtype=np.float64))
        self._starts, back = at[:-1], np.swapaxes(at[:-1], 1, 2)
        turn = rotations.logarithms(back @ at[1:])
        duration = np.diff(np.asarray(times_s))[:, None]
        velocity = self._velocities(turn, duration, np.asarray(rests))
        first = (back @ velocity[:-1, :, None])[:, :, 0]
        last = np.linalg.solve(rotations.left_jacobians(turn), back @ velocity[1:, :, None])[:, :, 0]
        slope = turn / duration
        self._c1 = first
        self._c2 = (3.0 * slope - 2.0 * first - last) / duration
        self._c3 = (first + last - 2.0 * slope) / duration**2
        self._step_s = _DIFFERENCE * duration

    def _velocities(self, turn: Array, duration: Array, rests: NDArray[np.bool_]) -> Array:
        """Angular velocities (k + 1, 3) [rad/s] at the way-points, in the base frame."""
        rate = (self._starts @ (turn / duration)[:, :, None])[:, :, 0]
        velocity = np.zeros((len(rate) + 1, 3))
        before, after = duration[:-1], duration[1:]
        velocity[1:-1] = (after * rate[:-1] + before * rate[1:]) / (before + after)
        velocity[rests] = 0.0
        return velocity

    def sample(self, section: NDArray[np.int64], t_s: Array) -> TurnSamples:
        """Rotation, angular velocity and acceleration in the base frame, `t_s` (m,) into each sample's section (m,)."""
        t, h = t_s[:, None], self._step_s[section]
        c1, c2, c3 = self._c1[section], self._c2[section], self._c3[section]
        start = self._starts[section]

        def velocity(time: Array) -> Array:
            r, rate = time * (c1 + time * (c2 + time * c3)), c1 + time * (2.0 * c2 + 3.0 * time * c3)
            return np.asarray((start @ (rotations.left_jacobians(r) @ rate[:, :, None]))[:, :, 0])

        return TurnSamples(
            rotation=start @ rotations.exponentials(t * (c1 + t * (c2 + t * c3))),
            velocity_rad_s=velocity(t),
            acceleration_rad_s2=(velocity(t + h) - velocity(t - h)) / (2.0 * h),
        )
