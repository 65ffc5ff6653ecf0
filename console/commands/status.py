"""`armwright status`: the state of the arm as text or JSON."""

import argparse
import math
from collections.abc import Sequence

from console.commands.connection import listening
from console.commands.end_effector import gripper_text, pin_text
from console.commands.progress import answer, say
from control.errors import ArmError
from control.model.description import load_arm
from control.plain_text import aligned, listed
from control.recording.recorder_state import RecorderState
from control.server.channel import Message

STALE = "*"


def run(args: argparse.Namespace) -> int:
    """Print the status; exit status 1 if the arm is in FAULT. Or print the table of modes, which needs no arm."""
    if args.modes:
        from control.safety.modes import table_text

        say(table_text())
        return 0
    client = listening(args)
    status = client.status()
    if getattr(args, "has_arm", True) or not args.socket:
        try:
            client.require_arm(load_arm(args.arm))
        except ArmError as error:
            status["warnings"].append(str(error))
    answer(args, status, described(status))
    return 1 if status["mode"] == "FAULT" else 0


def described(status: Message) -> str:
    """The status as text for an operator."""
    homed = "homed" if status["is_homed"] else "not homed"
    done = f", {100 * status['progress']:.0f} % of run {status['run']}" if status["run"] else ""
    pace = f", speed override {100 * status['override']:.0f} %" if status["override"] < 1.0 else ""
    step = f", {status['step']}" if status["step"] else ""
    held = f", client {status['in_control']} in control" if status.get("in_control") is not None else ""
    lines = [
        f"arm {status['arm']}: {status['mode']}, {homed}{done}{pace}{step}{held}",
        *_cell_line(status),
        "",
        aligned(_joint_rows(status)),
        _drive_line(status),
        "",
        *_stale_lines(status),
        *_tip_lines(status),
        *_end_lines(status),
        f"loop: {1e3 * status['period_s']:g} ms, p99 {1e6 * status['late_p99_s']:.0f} us late,"
        f" {1e6 * status['busy_p50_s']:.0f} us busy, {status['missed_cycles']} cycles missed",
    ]
    if status["recording"]:
        lines.append(_recording(RecorderState.of(status["recorder"])))
    lines += [f"warning: {warning}" for warning in status["warnings"]]
    lines += [f"FAULT {f['where']}: {f['message']}; {f['remedy']}" for f in status["faults"]]
    if status["faults"]:
        lines.append("when it is safe: `armwright acknowledge`, then `armwright enable`")
    return "\n".join(lines)


def _cell_line(status: Message) -> list[str]:
    """The other arms, where there are some."""
    if (cell := status.get("cell")) is None:
        return []
    others = ", ".join(f"{arm} {mode}" for arm, mode in cell["arms"].items() if arm != status["arm"])
    return [f"cell {cell['name']}: {others}"]


def _joint_rows(status: Message) -> list[tuple[str, ...]]:
    """Two lines of headings, then a line a joint: as wide for seven joints as for two."""
    encoder, drive = status["encoder_stale_s"], status["drive_stale_s"]
    columns = [
        ("joint", "", [str(joint) for joint in range(1, len(encoder) + 1)]),
        ("angle", "rad", _marked(_numbers(status["q_rad"], 4), encoder)),
        ("", "deg", _marked(_numbers([math.degrees(q) for q in status["q_rad"]], 2), encoder)),
        ("set-point", "rad", _numbers(status["q_set_rad"], 4)),
        ("error", "mrad", _marked(_numbers([1e3 * error for error in status["following_error_rad"]], 2), encoder)),
        ("count", "", _marked([str(count) for count in status["count"]], encoder)),
        ("current", "A", _marked(_numbers(status["current_A"], 2), drive)),
        ("supply", "V", _marked(_numbers(status["supply_V"], 1), drive)),
        ("", "°C", _marked(_numbers(status["temperature_C"], 0), drive)),
    ]
    return list(zip(*((name, unit, *cells) for name, unit, cells in columns), strict=True))


def _drive_line(status: Message) -> str:
    """The state of the drives, said once where joints share it."""
    states: dict[str, list[str]] = {}
    for joint, state in enumerate(_marked(status["drive_state"], status["drive_stale_s"]), 1):
        states.setdefault(state, []).append(str(joint))
    if len(states) == 1:
        return f"drives: {next(iter(states))}"
    return "drives: " + "; ".join(f"{', '.join(joints)} {state}" for state, joints in states.items())


def _tip_lines(status: Message) -> list[str]:
    lines = []
    if status["tip_m"]:
        mark = STALE if any(age is not None for age in status["encoder_stale_s"]) else ""
        lines.append(f"tip at {', '.join(_numbers(status['tip_m'], 4))} m{mark} by the arm's model")
    if status["camera_m"]:
        lines.append(f"tip at {', '.join(_numbers(status['camera_m'], 4))} m by the camera")
    if status["camera_problem"]:
        lines.append(f"tip not measured now: {status['camera_problem']}")
    return lines


def _end_lines(status: Message) -> list[str]:
    """Tool, gripper and pins, where the arm has them."""
    lines = [f"tool {status['tool']} is on"] if status["tools"] else []
    if status["gripper"] is not None:
        lines.append(gripper_text(status["gripper"]))
    return lines + [pin_text(name, pin) for name, pin in status["digital"].items()]


def _recording(recorder: RecorderState) -> str:
    is_on = "recording" if recorder.is_on else "not recording"
    return f"{is_on}: {recorder.file}, {1e-6 * recorder.written_bytes:.1f} MB written, {recorder.usage()}"


def _stale_lines(status: Message) -> list[str]:
    """Explain the stale marks: which boards are silent, and for how long."""
    silent: dict[tuple[str, str], list[str]] = {}
    for board, ages_s in (("encoder", status["encoder_stale_s"]), ("motor", status["drive_stale_s"])):
        for joint, age_s in enumerate(ages_s, 1):
            if age_s is not None:
                silent.setdefault((board, f"{age_s:.1f}"), []).append(str(joint))
    return [
        f"{STALE.strip()} joint{'s' * (len(joints) > 1)} {listed(joints)}: no report from {'their' if len(joints) > 1 else 'its'}"
        f" {board} board{'s' * (len(joints) > 1)} for {age} s; these are the last values"
        for (board, age), joints in silent.items()
    ]


def _marked(cells: Sequence[str], ages_s: Sequence[float | None]) -> list[str]:
    """The cells, with a mark at each value of a silent board."""
    return [cell if age_s is None else f"{cell}{STALE}" for cell, age_s in zip(cells, ages_s, strict=True)]


def _numbers(values: Sequence[float], decimals: int) -> list[str]:
    return [f"{value:z.{decimals}f}" for value in values]
