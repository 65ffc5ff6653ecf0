"""Calls ruckig, the library for jerk-limited trajectories, so that every way in which it can fail is one error.

Slow to import, so a client imports it with its first motion; the loop's process does before its first cycle (`prepare`).
`intermediate_positions` is never set: the community version sends
them to a remote service.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from control.motion.errors import MotionError

if TYPE_CHECKING:
    import ruckig

# ruckig 0.19.4 finds no trajectory over exactly 2 a^3 / j^2, where the acceleration limit is touched for no time: 0.05 rad with
# 10 rad/s^2 and 200 rad/s^3. A little less jerk and it does.
_JERK_SHARES = (1.0, 1.0 - 1e-7, 1.0 - 1e-4)


def prepare() -> None:
    """Import what motions need now: later it would cost cycles, or fail for want of memory or file descriptors."""
    import ruckig

    ruckig.Ruckig(1)


def calculated(asked: Any, jerk: Sequence[float], what: str) -> "ruckig.Trajectory":
    """The trajectory of an InputParameter that is complete but for its `max_jerk`. MotionError names `what` if there is none."""
    import ruckig

    trajectory = ruckig.Trajectory(len(jerk))
    for share in _JERK_SHARES:
        asked.max_jerk = [limit * share for limit in jerk]
        try:
            result = ruckig.Ruckig(len(jerk)).calculate(asked, trajectory)
        except (
            ruckig.RuckigError,
            ValueError,
        ):  # ValueError: a result that its own Result does not know, such as -101
            continue
        if result in (ruckig.Result.Working, ruckig.Result.Finished):
            return trajectory
    raise MotionError(f"{what}: there is no jerk-limited motion; ask for a slightly different one")
