"""Executes the steps of a recording plan, and saves each to disk before the arm continues.

points.csv gets a line per pose; runs/NAME.csv holds a run as recorded by the runtime. log.csv is made of all runs so far
when the recording ends, however it ends. An interrupted recording can be resumed.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from calib.errors import CalibrationError
from calib.gap.plan.plan import GENTLE, AVERAGE_s, RecordingPlan, Run, SETTLE_s, Step, Visit
from calib.points.writer import PointsWriter, Record
from control.errors import ArmError
from control.files import write_whole
from control.hardware.averaging import Average
from control.model.arm import Arm
from control.progress import Advance
from control.server.client import ArmClient
from procedures.gap.run_file import RunFile, write_log
from procedures.iso9283 import RunRows
from procedures.ports import RuntimePort, camera_said

REST_s = 0.1  # of a run after its motion
CAMERA_PATIENCE = 10  # in averages: a marker may be hidden for a moment
FLUSH_s = 0.3  # after a run, until its rows are on the disk: two write intervals of the recorder


@dataclass(frozen=True, slots=True)
class Bench:
    """A homed and holding arm: its client, the runtime's recording, whether there is a camera.

    `hang` attaches a mass to the tip, or asks the operator to; `speed` is that of moves between poses.
    """

    arm: Arm
    client: ArmClient
    recording: Path
    hang: Callable[[float], None]
    has_camera: bool = True
    speed: float = 1.0


def note_plan(out: Path, plan: RecordingPlan, arm: Arm) -> None:
    """Write plan.json; CalibrationError if the folder holds the records of another plan or arm."""
    path = out / "plan.json"
    wanted = json.dumps(plan_document(plan, arm), indent=1) + "\n"
    if path.exists() and path.read_text(encoding="utf-8") != wanted:
        raise CalibrationError(
            f"{path}: contains the records of another plan or arm: give the same options to continue, or choose"
            " another --out"
        )
    out.mkdir(parents=True, exist_ok=True)
    write_whole(path, wanted)


def plan_document(plan: RecordingPlan, arm: Arm) -> dict[str, object]:
    """What plan.json holds: every step in order."""
    return {
        "format": "gap_plan/1",
        "arm": arm.name,
        "duration_s": round(plan.duration_s, 1),
        "room_rad": [plan.room.lower_rad.tolist(), plan.room.upper_rad.tolist()],
        "steps": [_described(step) for step in plan.steps],
    }


def record(bench: Bench, plan: RecordingPlan, out: Path, advance: Advance) -> None:
    """Execute every step that is not done yet. log.csv is written from the recorded runs on every exit."""
    note_plan(out, plan, bench.arm)
    recorder = _Recorder(bench, out)
    try:
        for done, step in enumerate(plan.steps):
            advance(_step_name(step), done / len(plan.steps))
            recorder.take(step)
        recorder.take_off_load()
    finally:
        recorder.close()
        if plan.runs:
            write_log(out, bench.arm, [run.name for run in plan.runs])
    advance("recorded", 1.0)


class _Recorder:
    def __init__(self, bench: Bench, out: Path) -> None:
        self._bench, self._out = bench, out
        camera = bench.arm.camera
        pose_frame = "base" if camera is not None and camera.measures_orientation else ""
        self._points = PointsWriter(out / "points.csv", bench.arm.joint_count, pose_frame)
        self._rows = RunRows(bench.recording)
        self._port = RuntimePort(bench.client, bench.speed, as_encoders=True)
        self._gentle = RuntimePort(bench.client, GENTLE * bench.speed, as_encoders=True)
        self._load_kg = 0.0
        self._stands_out_of: tuple[float, ...] | None = None  # where to return before any other motion

    def take(self, step: Step) -> None:
        """Execute a step, unless it was done before."""
        if isinstance(step, Run):
            file = RunFile.of(self._out, step.name)
            if not file.exists():
                self._run(step, file)
        elif (step.setup, step.point, step.repeat) not in self._points.recorded:
            self._visit(step)

    def take_off_load(self) -> None:
        """Remove the load, at a pose from which every path is clear."""
        self._come_back(None)
        self._hang(0.0)

    def close(self) -> None:
        """Close the files."""
        self._points.close()

    def _visit(self, step: Visit) -> None:
        client = self._bench.client
        self._hang(step.payload_kg)
        self._come_back(
            step.via_rad if self._stands_out_of == step.via_rad and self._last == step.q_rad else None
        )
        if step.via_rad is not None and self._stands_out_of is None:
            self._port.move_to_q(step.via_rad)
        self._stands_out_of, self._last = step.via_rad, step.q_rad
        self._port.move_to_q(step.start_rad)
        self._gentle.move_to_q(step.q_rad)
        client.wait(SETTLE_s)
        mean = client.average(AVERAGE_s)  # angles and tip from the same time: an integral may still creep
        if mean.tip_m is None and self._bench.has_camera:
            mean = self._seen()
        seen = (
            mean.target if mean.tip_m is not None else None
        )  # a target in the camera's own frame tells nothing here
        self._points.append(
            Record(
                step.setup, step.point, step.repeat, mean.q_rad, mean.q_std_rad, mean.direction, mean.current_A, mean.t_s,
                step.payload_kg, mean.tip_m, orientation=None if seen is None else seen.orientation,
            )
        )  # fmt: skip

    def _seen(self) -> Average:
        """An average with camera frames of the tip; ArmError if there are none for a while."""
        for _ in range(CAMERA_PATIENCE):
            mean = self._bench.client.average(AVERAGE_s)
            if mean.tip_m is not None:
                return mean
        raise ArmError(
            f"no tip from the camera within {CAMERA_PATIENCE * AVERAGE_s:g} s{camera_said(self._bench.client)}: check that"
            " it is on and sees the tip"
        )

    _last: tuple[float, ...] | None = None

    def _come_back(self, stay_rad: tuple[float, ...] | None) -> None:
        """Return from a pose outside the workspace to its middle, before any other motion."""
        if self._stands_out_of is not None and stay_rad is None:
            self._port.move_to_q(self._stands_out_of)
            self._stands_out_of = None

    def _run(self, step: Run, file: Path) -> None:
        client = self._bench.client
        self._come_back(None)
        self._hang(step.payload_kg)
        self._port.move_to_q(step.path.knots[0].q_rad)
        client.wait(SETTLE_s)
        self._rows.skip()
        client.run_joints(step.path.to_message(), as_encoders=True)
        client.wait(FLUSH_s)
        rows = self._rows.of_run(int(client.status()["run"]))
        if not len(rows):
            raise ArmError(
                f"{self._bench.recording}: contains no rows of the run that just ended: check for a full disk"
            )
        rows = rows[rows["t_s"] <= rows["t_s"][0] + step.path.duration_s + REST_s]
        RunFile.write(file, rows, self._bench.arm, step.payload_kg)

    def _hang(self, mass_kg: float) -> None:
        if mass_kg != self._load_kg:
            self._come_back(None)
            self._bench.hang(mass_kg)
            self._bench.client.ask("payload", mass_kg=mass_kg)
            self._load_kg = mass_kg


def _step_name(step: Step) -> str:
    load = f" with {step.payload_kg:g} kg" if step.payload_kg else ""
    return f"run {step.name}: {step.kind}{load}" if isinstance(step, Run) else f"pose {step.point}{load}"


def _described(step: Step) -> dict[str, object]:
    if isinstance(step, Run):
        return {
            "run": step.name, "kind": step.kind, "payload_kg": step.payload_kg,
            "duration_s": round(step.path.duration_s, 3), "start_rad": list(step.path.knots[0].q_rad),
        }  # fmt: skip
    return {
        "setup": step.setup, "point": step.point, "repeat": step.repeat, "payload_kg": step.payload_kg, "q_rad": list(step.q_rad),
        "direction": list(step.direction),
    }  # fmt: skip
