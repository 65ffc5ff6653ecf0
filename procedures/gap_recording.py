"""Records a plan of poses and motions: its steps as stops of a tour (`procedures.tour`).

points.csv gets a line per pose; runs/NAME.csv holds a run as recorded by the runtime: unaligned rows, one per cycle, which
`procedures.gap_timing` aligns. log.csv is made of all runs so far when the recording ends, however it ends.

"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calib.gap.log import LogFileError, LoggedRun
from calib.gap.plan.plan import GENTLE, AVERAGE_s, PlannedRun, RecordingPlan, SETTLE_s, Step
from calib.points.writer import PointsWriter, replace_file
from calib.session.take import SessionSettings
from control.model.arm import Arm
from control.plain_text import Advance
from control.recording.record import LEAD_FIELD
from control.tables import SAMPLES_MOST, opened_rows
from procedures.gap_timing import Aligned, Raw, aligned, clocks_of, lead_rad_of
from procedures.tour import Bench, How, Rows, Stop, note_plan, remaining, tour

TIP = ("x_m", "y_m", "z_m")
GROUPS = {"q{}_rad": "q_rad", "q{}_set_rad": "q_set_rad", "i{}_A": "current_A", "u{}_V": "voltage_V"}
LEADS = LEAD_FIELD[0]  # of joints with an encoder on the motor, too


class RunFile:
    """runs/NAME.csv in the folder of a recording."""

    @staticmethod
    def of(out: Path, name: str) -> Path:
        """The file of a run."""
        return out / "runs" / f"{name}.csv"

    @staticmethod
    def write(path: Path, rows: npt.NDArray[np.void], arm: Arm, payload_kg: float) -> None:
        """Write the rows of a run atomically.

        Where a board sets its motor's voltage itself, what the runtime told it beside position or current is none.
        """
        joints = range(1, arm.joint_count + 1)
        recorded = rows.dtype.names or ()
        leads = [name for name in map(LEADS.format, joints) if name in recorded]
        names = ["t_s", *_joint_names(arm.joint_count), *(f"counted{j}_s" for j in joints), *TIP, *leads]
        hidden = {f"u{drive.joint}_V" for drive in arm.drives if drive.pid.mode != "voltage"}
        table = np.column_stack(
            [np.full(len(rows), np.nan) if name in hidden else rows[name].astype(np.float64) for name in names]
        )
        text = [",".join([*names, "payload_kg"])]
        text += [",".join([*(_cell(x, 12) for x in row), f"{payload_kg:g}"]) for row in table.tolist()]
        replace_file(path, ("\n".join(text) + "\n").encode())

    @staticmethod
    def read(path: Path, joint_count: int) -> Raw:
        """Read a run. LogFileError if it is not one that `write` has written."""
        try:
            return RunFile._read(path, joint_count)
        except (OSError, ValueError, KeyError, IndexError, StopIteration) as error:
            raise LogFileError(
                f"{path}: not a run of `armwright gap record` ({error or 'empty'}): remove it, and record it again"
            ) from None

    @staticmethod
    def _read(path: Path, joint_count: int) -> Raw:
        with opened_rows(path, ValueError, SAMPLES_MOST) as reader:
            header = next(reader)
            table = np.array([[float(cell or "nan") for cell in row] for row in reader])
        column = {name: table[:, k] for k, name in enumerate(header)}

        def group(form: str) -> npt.NDArray[np.float64]:
            return np.column_stack([column[form.format(j)] for j in range(1, joint_count + 1)])

        none = np.full(len(table), np.nan)
        leads = [column.get(LEADS.format(j), none) for j in range(1, joint_count + 1)]

        return Raw(
            column["t_s"],
            group("q{}_rad"),
            group("q{}_set_rad"),
            group("i{}_A"),
            group("u{}_V"),
            group("counted{}_s"),
            np.column_stack([column[name] for name in TIP]),
            float(column["payload_kg"][0]),
            np.column_stack(leads),
        )


def write_log(out: Path, arm: Arm, names: Sequence[str]) -> tuple[str, ...]:
    """Write log.csv from all runs, on one clock; returns messages about the delays removed."""
    n = arm.joint_count
    there = [(name, RunFile.of(out, name)) for name in names]
    runs = [(name, RunFile.read(path, n)) for name, path in there if path.exists()]
    if not runs:
        return ()
    rows = []
    for session in _by_runtime(runs):
        clocks = clocks_of(arm, [raw for _, raw in session])
        rows += [(name, aligned(arm, raw, clocks), raw.payload_kg) for name, raw in session]
    replace_file(out / "log.csv", log_text(n, rows).encode())
    return clocks.in_words()


def _by_runtime(runs: Sequence[tuple[str, Raw]]) -> list[list[tuple[str, Raw]]]:
    """The runs by the runtimes that recorded them: each has a clock of its own, and the boards may have gone on with theirs."""
    apart: list[list[tuple[str, Raw]]] = [[]]
    for name, raw in runs:
        if apart[-1] and raw.t_s[0] < apart[-1][-1][1].t_s[0]:
            apart.append([])
        apart[-1].append((name, raw))
    return apart


def log_text(joint_count: int, runs: Sequence[tuple[str, Aligned | LoggedRun, float]]) -> str:
    """log.csv of runs by their names, each with its payload [kg]; without the quantities that none of them has.

    An empty voltage would say that a driver is off: where a board sets a joint's voltage itself, the log has no voltages.
    """
    groups = [[getattr(run, name) for _, run, _ in runs] for name in GROUPS.values()]
    has = [any(np.isfinite(values).any() for values in group) for group in groups]
    has[-1] = bool(np.any([np.isfinite(volts).any(axis=0) for volts in groups[-1]], axis=0).all())
    has[-1] |= any(isinstance(run, LoggedRun) and run.is_commanded for _, run, _ in runs)  # then none: driver off
    names = [name for name, is_there in zip(_joint_names(joint_count), np.repeat(has, joint_count), strict=True) if is_there]
    leads = [lead_rad_of(run, joint_count) for _, run, _ in runs]
    has_lead = np.any([np.isfinite(lead_rad).any(axis=0) for lead_rad in leads], axis=0)
    names_of_leads = [LEADS.format(j + 1) for j in np.flatnonzero(has_lead)]
    lines = [",".join(["run", "t_s", *names, *TIP, *names_of_leads, "payload_kg"])]
    for at, (name, run, payload_kg) in enumerate(runs):
        there = [group[at] for group, is_there in zip(groups, has, strict=True) if is_there]
        table = np.column_stack((run.t_s, *there, run.tip_m, leads[at][:, has_lead]))
        end = f"{payload_kg:g}"
        lines += [",".join([name, *(_cell(x) for x in row), end]) for row in table.tolist()]
    return "\n".join(lines) + "\n"


def _joint_names(n: int) -> list[str]:
    """Column names by quantity."""
    return [form.format(j) for form in GROUPS for j in range(1, n + 1)]


def _cell(value: float, digits: int = 9) -> str:
    return "" if value != value else f"{value:.{digits}g}"


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

    announcing_bench = replace(bench, hang=hang)
    try:
        with PointsWriter(out / "points.csv", arm.joint_count, pose_frame) as points:
            runs = _RunFiles(arm, out)
            stops = remaining(map(_stop, plan.steps), points, runs)
            for done, stop in enumerate(tour(announcing_bench, HOW, stops, points, runs)):
                advance(stop.name, done / len(stops))
    finally:
        if plan.runs:
            write_log(out, arm, [run.name for run in plan.runs])
    advance("recorded", 1.0)


@dataclass(frozen=True, slots=True)
class _RunFiles:
    """runs/NAME.csv of each run."""

    arm: Arm
    out: Path

    def has(self, run: PlannedRun) -> bool:
        return RunFile.of(self.out, run.name).exists()

    def keep(self, run: PlannedRun, rows: Rows) -> None:
        is_of_run = rows["t_s"] <= rows["t_s"][0] + run.path.duration_s + REST_s
        RunFile.write(RunFile.of(self.out, run.name), rows[is_of_run], self.arm, run.payload_kg)


def _stop(step: Step) -> Stop[PlannedRun]:
    load = f" with {step.payload_kg:g} kg" if step.payload_kg else ""
    if isinstance(step, PlannedRun):
        start = tuple(step.path.knots[0].q_rad)
        return Stop(f"run {step.name}: {step.kind}{load}", step.path, (start,), run=step, payload_kg=step.payload_kg)
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
    if isinstance(step, PlannedRun):
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
