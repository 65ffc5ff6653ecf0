"""The active motion: a planned one, or the stop that replaces it. Writes `paced`; a stop elsewhere writes the set-point."""

from control.loop.arm_state import ArmState
from control.motion.pace import Paced
from control.motion.setpoint import Motion, SetPoint


def begin(state: ArmState, motion: Motion, pace: float) -> None:
    """Start `motion` now."""
    limits = [limit.acceleration_rad_s2 for limit in state.parts.set_point_limits]
    state.paced = Paced(motion, limits, pace)


def stop_from(state: ArmState, point: SetPoint) -> None:
    """Plan the jerk-limited stop from `point`; brake if there is none."""
    if point is not state.set_point:
        state.set_point = point
        state.parts.servo.reset()
    begin(state, state.parts.stop_from(point), 1.0)
