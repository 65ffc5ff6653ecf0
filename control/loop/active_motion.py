"""The active motion: a planned one, or the stop that replaces it.

Writes `paced` and `stops_along`; a stop elsewhere writes the set-point.
"""

from collections.abc import Sequence

from control.loop.arm_state import ArmState
from control.motion.pace import Limited, Paced
from control.motion.setpoint import Motion, SetPoint

STOP_WITHIN_S = 0.4  # from full speed and pace it takes 0.3 s, the joints' own stops 0.25 s


def begin(state: ArmState, motion: Motion, pace: float, beside: Sequence[Limited] = ()) -> None:
    """Start `motion` now; `beside`: motions of other arms that keep its pace."""
    state.stops_along = False
    state.paced = Paced(motion, limits_of(state), pace, beside)


def limits_of(state: ArmState) -> Sequence[float]:
    """Of each joint's acceleration [rad/s2]."""
    return [limit.acceleration_rad_s2 for limit in state.parts.set_point_limits]


def stop_along(state: ArmState) -> bool:
    """Let the active motion slow down to rest on its own path, if that is soon enough; return whether it is."""
    state.stops_along = state.paced is not None and state.paced.can_rest(STOP_WITHIN_S)
    return state.stops_along


def stop_from(state: ArmState, point: SetPoint) -> None:
    """Plan the jerk-limited stop from `point`; brake if there is none."""
    if point is not state.set_point:
        state.set_point = point
        state.parts.servo.reset()
    plan = state.parts.tool.guard.stop_from if state.monitor.is_homed else state.parts.stop_from
    begin(state, plan(point), 1.0)
