"""Records a plan of poses and motions: its steps as stops of a tour (`procedures.tour`).

points.csv gets a line per pose; runs/NAME.csv holds a run as recorded by the runtime. log.csv is made of all runs so far
when the recording ends, however it ends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

from calib.gap.plan.plan import GENTLE, AVERAGE_s, RecordingPlan, Run, SETTLE_s, Step
from calib.points.writer import PointsWriter
from calib.session.take import SessionSettings
from control.model.arm import Arm
from control.progress import Advance
from procedures.gap.run_file import RunFile, write_log
from procedures.tour import Bench, How, Rows, Stop, note_plan, tour

REST_s = 0.1  # of a run after its motion
# For a time, not until rest: an arm that creeps is to be seen as it is.
HOW = How(SessionSettings(still_limit_rad=math.inf, still_s=SETTLE_s, average_s=AVERAGE_s), as_encoders=True)


def note(out: Path, plan: RecordingPlan, arm: Arm) -> None:
    """Write plan.json; CalibrationError if the folder holds the records of another plan or arm."""
    note_plan(out / "plan.json", plan_document(plan, arm), indent=1)


def plan_document(plan: RecordingPlan, arm: Arm) -> dict[str, object]:
    """What plan.json holds: every step in order."""
    return {
        "format": "gap_plan/1",
        "arm": arm.name,
        "duration_s": round(plan.duration_s, 1),
        "room_rad": [plan.room.lower_rad.tolist(), plan.room.upper_rad.tolist()],
        "steps": [_described(step) for step in plan.steps],
    }


def record(arm: Arm, bench: Bench, plan: RecordingPlan, out: Path, advance: Advance) -> None:
    """Execute every step that is not done yet. log.csv is written from the recorded runs on every exit."""
    note(out, plan, arm)
    camera = arm.camera
    pose_frame = "base" if camera is not None and camera.measures_orientation else ""

    def hang(mass_kg: float) -> None:
        if bench.hang is not None:
            bench.hang(mass_kg)
        bench.client.ask("payload", mass_kg=mass_kg)

    told = replace(bench, hang=hang)
    try:
        with PointsWriter(out / "points.csv", arm.joint_count, pose_frame) as points:
            stops = tour(told, HOW, map(_stop, plan.steps), points, _RunFiles(arm, out))
            for done, stop in enumerate(stops):
                advance(stop.name, done / len(plan.steps))
    finally:
        if plan.runs:
            write_log(out, arm, [run.name for run in plan.runs])
    advance("recorded", 1.0)


def record_on_mock(
    arm: Arm, scenario: str, seed: int | None, plan: RecordingPlan, out: Path, advance: Advance
) -> None:
    """Home a mock of `arm` and record; its scenario is saved in `out`, the runtime's recordings in `out`/log."""
    from procedures.mock import saved_mock  # imports the physics

    note(out, plan, arm)
    advance("homing", 0.0)
    with saved_mock(arm, scenario, seed, out) as (bench, client, recording):
        record(arm, Bench(client, recording, bench.rig.set_payload), plan, out, advance)


@dataclass(frozen=True, slots=True)
class _RunFiles:
    """runs/NAME.csv of each run."""

    arm: Arm
    out: Path

    def has(self, run: Run) -> bool:
        return RunFile.of(self.out, run.name).exists()

    def keep(self, run: Run, rows: Rows) -> None:
        is_of_run = rows["t_s"] <= rows["t_s"][0] + run.path.duration_s + REST_s
        RunFile.write(RunFile.of(self.out, run.name), rows[is_of_run], self.arm, run.payload_kg)


def _stop(step: Step) -> Stop[Run]:
    load = f" with {step.payload_kg:g} kg" if step.payload_kg else ""
    if isinstance(step, Run):
        start = tuple(step.path.knots[0].q_rad)
        return Stop(
            f"run {step.name}: {step.kind}{load}", step.path, (start,), run=step, payload_kg=step.payload_kg
        )
    return Stop(
        f"pose {step.point}{load}",
        step.q_rad,
        (step.start_rad,),
        GENTLE,
        key=(step.setup, step.point, step.repeat),
        payload_kg=step.payload_kg,
        out_rad=step.via_rad,
    )


def _described(step: Step) -> dict[str, object]:
    if isinstance(step, Run):
        return {
            "run": step.name,
            "kind": step.kind,
            "payload_kg": step.payload_kg,
            "duration_s": round(step.path.duration_s, 3),
            "start_rad": list(step.path.knots[0].q_rad),
        }
    return {
        "setup": step.setup,
        "point": step.point,
        "repeat": step.repeat,
        "payload_kg": step.payload_kg,
        "q_rad": list(step.q_rad),
        "direction": list(step.direction),
    }
