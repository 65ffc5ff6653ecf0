"""The runtime's state as a JSON object, the answer of `status` (docs/socket.md)."""

import math
import time
from collections.abc import Sequence
from typing import Any

from control.end_effector import GripState as GripperState
from control.kinematics.kinematics import PoseKinematics
from control.kinematics.rotation import quaternion_of
from control.loop.on_and_off import TAKES_OVER, doubt
from control.loop.runtime import Runtime
from control.recording.recorder_state import RecorderState
from control.safety.modes import CONTROLLED_MODES, Mode
from firmware_iface.motor.cia402 import STATE_OF_STATUSWORD

CAMERA_FRESH_S = 0.5
FEW_HOURS = 1.0  # of recording left: time to make room
NEVER_HEARD_S = 1e6  # JSON has no infinity
SHUTDOWN_STEPS = {
    Mode.STOPPING: "stopping",
    Mode.HOLDING: "holding until the arm is at rest",
    Mode.BRAKED: "lowering: windings shorted until the arm is at rest",
    Mode.FAULT: "in FAULT, waiting for the arm to come to rest",
    Mode.OFF: "waiting for the drives to switch off",
    Mode.HELD: "taking the arm over from its boards",
}
NEAR = 0.9  # of a limit: warn below
_ADVICE = "`armwright acknowledge` when it is safe"
_HELD_ADVICE = f"a reset would let the arm go; {TAKES_OVER} where it only timed out, `armwright off` lets it go"


def status_of(runtime: Runtime) -> dict[str, Any]:
    """The complete state of the arm for operators and programs."""
    monitor = runtime.monitor
    recorder = runtime.parts.recorder.state()
    return {
        "mode": monitor.mode.name,
        "drives": runtime.drives.wanted.name,
        "run": runtime.run_number,
        "is_homed": monitor.is_homed,
        "t_s": runtime.now_s,
        "cycle": runtime.cycles,
        **_angles(runtime, runtime.parts.tool.inverse.poses),
        **_boards(runtime),
        "progress": runtime.progress(),
        "pace": runtime.pace(),
        "was_stopped": runtime.was_stopped,
        "stop_reason": runtime.stop_reason,
        "step": step_of(runtime),
        "is_weightless": runtime.is_weightless and monitor.mode is Mode.GUIDING,
        "override": runtime.override,
        "tool": runtime.parts.tool.tool.name,
        "tools": [name for name in runtime.parts.tools if name],
        "payload_kg": runtime.stated_payload_kg,
        "gripper": gripper_status(runtime),
        "digital": _digital(runtime),
        "faults": [{"code": f.code, "where": f.where, "message": f.message, "remedy": f.remedy} for f in monitor.faults],
        "warnings": [*_warnings(runtime), *_recorder_warnings(recorder)],
        **_cycles(runtime),
        "lost_rows": recorder.lost_rows,
        "recording": recorder.file,
        "recorder": recorder.content(),
    }


def gripper_status(runtime: Runtime) -> dict[str, Any] | None:
    """State and values of the gripper; None without one."""
    if (gripper := runtime.parts.gripper) is None:
        return None
    goal = gripper.goal
    return {
        "state": gripper.state.name,
        "is_moving": gripper.state is GripperState.MOVING,
        "text": gripper.state.value + (f": {gripper.why}" if gripper.why else ""),
        "opening_m": gripper.opening_m,
        "goal_m": goal.opening_m if goal is not None else None,
        "force_N": abs(gripper.feedback.current_A) * gripper.described.constant_N_A,
        "current_A": gripper.feedback.current_A,
        "has_lost": gripper.has_lost,
        "number": gripper.number,
    }


def _digital(runtime: Runtime) -> dict[str, Any]:
    """Direction and level of each pin by name; null: its board does not say."""
    outputs = runtime.parts.outputs
    if outputs is None:
        return {}
    return {pin.name: {"direction": pin.direction, "level": outputs.levels[pin.name]} for pin in outputs.described}


def step_of(runtime: Runtime) -> str:
    """The present step of homing, or of the way on or off, as text; empty if there is none."""
    if runtime.homing is not None:
        return runtime.homing.step_text
    if runtime.bound.is_off:
        return SHUTDOWN_STEPS.get(runtime.monitor.mode, "")
    return "switching the drives on" if runtime.bound.is_hold else ""


def _angles(runtime: Runtime, kinematics: PoseKinematics) -> dict[str, Any]:
    """Actual values and set-points of encoders, joints and tip."""
    measured, aim = runtime.parts.measurement, runtime.aim
    joint_rad, joint_set_rad = runtime.joint_rad()
    is_homed = runtime.monitor.is_homed
    tip_m, rotation, _ = kinematics.at(*joint_rad)
    sees_tip = runtime.now_s - runtime.camera_at_s < CAMERA_FRESH_S
    return {
        "q_rad": measured.q_rad,
        "q_set_rad": aim.q_rad,
        "joint_rad": joint_rad,
        "joint_set_rad": joint_set_rad,
        "speed_rad_s": measured.speed_rad_s,
        "following_error_rad": [s - m for s, m in zip(aim.q_rad, measured.q_rad, strict=True)],
        "direction": measured.direction,
        "tip_m": tip_m if is_homed else None,
        "tip_set_m": kinematics.kinematics.tip(*joint_set_rad) if is_homed else None,
        "tip_orientation": quaternion_of(rotation) if is_homed else None,
        "camera_m": runtime.camera_m if sees_tip else None,
        "camera_problem": _camera_problem(runtime, sees_tip),
    }


def _camera_problem(runtime: Runtime, sees_tip: bool) -> str:
    """Why the tip is not measured; a camera that has gone says nothing any more."""
    camera = runtime.parts.camera
    problem = camera.problem() if camera is not None else ""
    age_s = runtime.now_s - runtime.camera_at_s
    return problem or ("" if sees_tip or math.isinf(age_s) else f"its last frame came {age_s:.1f} s ago")


def _boards(runtime: Runtime) -> dict[str, Any]:
    """Latest values of the boards, and their age if a board is silent."""
    parts = runtime.parts
    feedback = parts.hardware.feedback
    return {
        "count": feedback.count,
        "current_A": feedback.current_A,
        "supply_V": feedback.supply_V,
        "temperature_C": feedback.temperature_C,
        "output": parts.servo.output,
        "output_mode": [mode.name for mode in parts.servo.modes],
        "drive_state": [_state_name(word) for word in feedback.statusword],
        "encoder_stale_s": _stale_s(runtime, feedback.reported_at_s),
        "drive_stale_s": _stale_s(runtime, feedback.reply_at_s),
    }


def _stale_s(runtime: Runtime, heard_at_s: Sequence[float]) -> list[float | None]:
    """Per joint, age [s] of its last values if its board is silent, else None."""
    now_s, watch = runtime.now_s, runtime.parts.checks.watch
    return [min(now_s - at_s, NEVER_HEARD_S) if watch.is_stale(now_s, at_s) else None for at_s in heard_at_s]


def _cycles(runtime: Runtime) -> dict[str, Any]:
    """Timing statistics of the loop."""
    punctuality = runtime.punctuality
    return {
        "period_s": runtime.parts.period_s,
        "missed_cycles": punctuality.missed,
        "late_p99_s": punctuality.late_s(0.99),
        "busy_p50_s": punctuality.busy_s(0.5),
    }


def _state_name(statusword: int) -> str:
    state = STATE_OF_STATUSWORD[statusword]
    return state.value if state else f"no state (0x{statusword:02x})"


def _warnings(runtime: Runtime) -> list[str]:
    parts, monitor = runtime.parts, runtime.monitor
    warnings = []
    for name, bits in zip(parts.joint_names, parts.hardware.feedback.drive_faults, strict=True):
        if bits and not monitor.faults:
            is_held = monitor.mode is Mode.HELD
            warnings.append(f"the drive of {name} is in FAULT (bits 0x{bits:02x}): {_HELD_ADVICE if is_held else _ADVICE}")
    if out := runtime.drives.out_of_operation(parts.hardware.feedback):
        warnings.append(f"the drive of {', '.join(out)} is out of operation: `armwright enable` takes it back")
    if runtime.jogging is not None and runtime.jogging.limited:
        warnings.append(runtime.jogging.limited)
    if monitor.mode in CONTROLLED_MODES - {Mode.HOMING} and not monitor.is_homed:
        warnings.append("not homed: joint angles are not valid yet (`armwright home`)")
    if monitor.is_homed:
        warnings += _near_range(runtime)
    elif why := doubt(runtime):
        warnings.append(why)
    return warnings


def _recorder_warnings(recorder: RecorderState) -> list[str]:
    """Warnings about lost rows, with the reason, and about a disk that will soon be full."""
    warnings = []
    if recorder.reason:
        since = time.strftime("%H:%M:%S", time.localtime(recorder.since_unix_s))
        warnings.append(
            f"recording stopped at {since}: {recorder.file}: {recorder.reason}; {recorder.lost_rows} cycles were not"
            " recorded. Recording resumes when there is room"
        )
    elif recorder.lost_rows:
        warnings.append(
            f"{recorder.lost_rows} cycles are in no file: the disk was full or too slow, or another program removed them"
        )
    if recorder.is_on and recorder.hours_left is not None and recorder.hours_left < FEW_HOURS:
        warnings.append(f"{recorder.file}: the disk will be full in {recorder.time_left()}")
    return warnings


def _near_range(runtime: Runtime) -> list[str]:
    warnings = []
    for name, limit, q in zip(
        runtime.parts.joint_names, runtime.parts.set_point_limits, runtime.parts.measurement.q_rad, strict=True
    ):
        room = min(q - limit.lower_rad, limit.upper_rad - q)
        if room < 0.0:
            warnings.append(f"{name} is {-room:.3f} rad beyond the end of its range: jog or move it back")
        elif room < (1.0 - NEAR) * 0.5 * (limit.upper_rad - limit.lower_rad):
            warnings.append(f"{name} is {room:.3f} rad from the end of its range")
    return warnings
