"""One cycle as a row of the recording, in the order of control.recording.record.Layout."""

import math

from control.end_effector.grip_state import GripState
from control.loop import set_points
from control.loop.arm_state import ArmState
from control.recording.record import COUNT_MOST
from control.safety.table import Mode

GRIPPER_STATE_NUMBER = {state: number for number, state in enumerate(GripState)}
MODE_NUMBER = {mode: number for number, mode in enumerate(Mode)}  # as recorded


def row_of(state: ArmState, late_s: float) -> list[float]:
    """The values of the cycle that is about to end and began `late_s` after its deadline."""
    feedback, measured, volts = (
        state.parts.hardware.feedback,
        state.parts.measurement,
        state.parts.servo.volts,
    )
    mode, aim = state.monitor.mode, state.aim
    page_faults, switches = state.punctuality.strain()
    age_s = state.now_s - feedback.encoder_at_s
    row = [
        state.now_s, state.cycles & 0xFFFFFFFF, state.run_number, MODE_NUMBER[mode],
        state.punctuality.missed, late_s, state.punctuality.end(), min(page_faults, COUNT_MOST),
        min(switches, COUNT_MOST), age_s if age_s < math.inf else math.nan, state.stated_payload_kg, *state.new_camera_m,
    ]  # fmt: skip
    joints = set_points.joint_rad(state) if state.parts.joint_side is not None else None
    is_open = mode in (Mode.GUIDING, Mode.OFF)
    for joint in range(feedback.joint_count):
        row += (
            measured.q_rad[joint], aim.q_rad[joint],
            measured.speed_rad_s[joint], aim.speed_rad_s[joint], feedback.count[joint],
            math.nan if is_open else volts[joint], feedback.current_A[joint],
            feedback.supply_V[joint], feedback.temperature_C[joint], feedback.statusword[joint],
            feedback.drive_faults[joint], feedback.channel_flags[joint], feedback.counted_at_s[joint],
        )  # fmt: skip
        if joints is not None:
            row += (joints[0][joint], joints[1][joint])
    return row + _end_of(state)


def _end_of(state: ArmState) -> list[float]:
    """The columns of control.recording.layout: what is at the end of the arm."""
    parts = state.parts
    row: list[float] = [list(parts.tools).index(parts.tool.tool.name)] if len(parts.tools) > 1 else []
    if (gripper := parts.gripper) is not None:
        goal_m = gripper.goal.opening_m if gripper.goal is not None else None
        row += [
            math.nan if gripper.opening_m is None else gripper.opening_m, math.nan if goal_m is None else goal_m,
            gripper.feedback.current_A, GRIPPER_STATE_NUMBER[gripper.state],
        ]  # fmt: skip
    if parts.outputs is not None:
        row.append(sum(1 << bit for bit, level in enumerate(parts.outputs.levels.values()) if level))
    return row
