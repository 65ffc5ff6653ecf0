"""`armwright status`: what the arm does now, in words or as JSON."""

import argparse
import json
import sys
from collections.abc import Sequence

from console.commands.connection import connected
from control.recording.recorder_state import RecorderState
from control.server.client import Message


def run(given: argparse.Namespace) -> int:
    """Print the status; exit status 1 when the arm is in FAULT."""
    status = connected(given).status()
    text = json.dumps(status, indent=2) if given.json else described(status)
    sys.stdout.write(f"{text}\n")
    return 1 if status["mode"] == "FAULT" else 0


def described(status: Message) -> str:
    """The status as a page for an operator."""
    homed = "homed" if status["is_homed"] else "not homed"
    done = f", {100 * status['progress']:.0f} % of run {status['run']}" if status["run"] else ""
    pace = f", at {100 * status['override']:.0f} % of the pace" if status["override"] < 1.0 else ""
    lines = [
        f"arm {status['arm']}: {status['mode']}, {homed}{done}{pace}",
        "",
        _row("joint", [f"{joint + 1}" for joint in range(len(status["q_rad"]))]),
        _row("angle [rad]", _numbers(status["q_rad"], 4)),
        _row("set-point [rad]", _numbers(status["q_set_rad"], 4)),
        _row("following error [mrad]", _numbers([1e3 * e for e in status["following_error_rad"]], 2)),
        _row("count", [str(count) for count in status["count"]]),
        _row("current [A]", _numbers(status["current_A"], 2)),
        _row("supply [V]", _numbers(status["supply_V"], 1)),
        _row("temperature [°C]", _numbers(status["temperature_C"], 0)),
        _row("drive", status["drive_state"]),
        "",
    ]
    if status["tip_m"]:
        lines.append(f"tip at {', '.join(_numbers(status['tip_m'], 4))} m by the arm's model")
    if status["camera_m"]:
        lines.append(f"tip at {', '.join(_numbers(status['camera_m'], 4))} m by the camera")
    lines.append(
        f"loop: {1e3 * status['period_s']:g} ms, p99 {1e6 * status['late_p99_s']:.0f} us late,"
        f" {1e6 * status['busy_p50_s']:.0f} us busy, {status['missed_cycles']} cycles missed"
    )
    if status["recording"]:
        lines.append(_recording(RecorderState.of(status["recorder"])))
    lines += [f"warning: {warning}" for warning in status["warnings"]]
    lines += [f"FAULT {f['where']}: {f['message']}; {f['remedy']}" for f in status["faults"]]
    if status["faults"]:
        lines.append("when it is safe: `armwright acknowledge`, then `armwright enable`")
    return "\n".join(lines)


def _recording(recorder: RecorderState) -> str:
    is_on = "recording" if recorder.is_on else "NOT recording"
    return f"{is_on}: {recorder.file}, {1e-6 * recorder.written_bytes:.1f} MB written, {recorder.usage()}"


def _row(name: str, cells: Sequence[str]) -> str:
    return f"{name:<24}" + "".join(f"{cell:>20}" for cell in cells)


def _numbers(values: Sequence[float], decimals: int) -> list[str]:
    return [f"{value:.{decimals}f}" for value in values]
