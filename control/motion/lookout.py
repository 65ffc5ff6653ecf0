"""Looks at the poses of a motion before the arm can no longer rest ahead of them.

Motions are checked before they begin, but only at knots. What lies between them is seen here, while the arm can still stop
on the motion's own path.
"""

from copy import copy

from control.motion.setpoint import Motion, SetPoint

AHEAD_s = 0.25  # of the motion's time: a stop along the path takes 0.15 from full pace, and more where joints are at their limits
STEP_s = 0.01  # between poses; at 10 m/s^2 the tip departs from their chord by 0.1 mm
_AT_ONCE = 2  # poses a cycle, so that the way to AHEAD_s is made up in 30 ms, before the arm has got up speed


class Lookout:
    """The poses of one motion, each given once, in the order of time."""

    __slots__ = ("_motion", "_seen_s")

    def __init__(self, motion: Motion) -> None:
        self._motion = copy(motion)  # a path continues from the pose that it gave last, so the arm's own is left alone
        self._seen_s = 0.0

    def poses(self, time_s: float) -> list[SetPoint]:
        """The next poses up to AHEAD_s after `time_s` of the motion; empty once all were given. Raises what the motion does."""
        end_s = min(time_s + AHEAD_s, self._motion.duration_s)
        set_points: list[SetPoint] = []
        while self._seen_s < end_s and len(set_points) < _AT_ONCE:
            self._seen_s = min(self._seen_s + STEP_s, self._motion.duration_s)
            set_points.append(self._motion.at(self._seen_s))
        return set_points
