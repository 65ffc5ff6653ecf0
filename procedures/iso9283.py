"""Runs the test programmes of calib.iso9283 on an arm with a camera, or on its mock, and evaluates what was
recorded.

In: a test cube and an extent. Out: points.csv, log.csv and programme.json, each record on disk before the arm
goes on; then iso9283.json and iso9283.html.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.iso9283.evaluation import evaluate
from calib.iso9283.pose_criteria import Iso9283Error
from calib.iso9283.programme import (
    Extent,
    PathRun,
    Point,
    Solver,
    Step,
    TestCube,
    Visit,
    path_programme,
    programme_document,
    solver_of,
    steps,
)
from calib.iso9283.recorded import BESIDE, SET, PoseGroup, RecordedRun, pose_groups, read_rectangle, read_runs
from calib.iso9283.result import Evaluation, write_document, write_page
from calib.points.points import TIP, read_points, require_recorded_of
from calib.points.writer import PointsWriter, cell
from calib.results import InputFile, input_file, made_today
from calib.session.take import SessionSettings
from control.files import KeptLines
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.motion.plan import PlannedPath, plan_path
from control.plain_text import Advance
from procedures.tour import Bench, How, Rows, Stop, note_plan, remaining, tour

# For a time, not until rest: what an arm still does then is what the criteria measure. 20 camera frames are averaged.
HOW = How(SessionSettings(still_limit_rad=math.inf, still_s=0.2, average_s=0.2), needs_tip=False)
KEEP_EVERY = 5  # cycles of a path without a camera
_SPEED_ROUNDS = 6
_BETWEEN = 24  # samples between two poses: 20 mm apart for the longest moves


@dataclass(frozen=True, slots=True)
class Planned:
    """The checked plan: steps with the joint angles of their poses."""

    document: dict[str, object]
    steps: tuple[Step, ...]
    q_rad: dict[Point, tuple[float, ...]]
    paths: dict[tuple[Point, ...], dict[float, PlannedPath]]


def rated_speed_m_s(arm: Arm, cube: TestCube) -> float:
    """The largest speed on the test's straight line that needs no slowing, at most the tip's limit."""
    speed = arm.limits.tip_speed_m_s
    line = next(path_programme(cube, 1, (1.0,), 1.0))
    near = _solved(solver_of(arm, cube), line.points_m[0])
    for _ in range(_SPEED_ROUNDS):
        planned = plan_path(arm, line.points_m, [speed * share for share in line.speeds_m_s], q_near_rad=near)
        if not planned.slowdowns:
            break
        speed = math.floor(100.0 * speed / max(s.factor for s in planned.slowdowns)) / 100.0
    return speed


def largest_load_kg(arm: Arm, cube: TestCube) -> float:
    """The load at P1 that the loop does not take for a collision: nobody tells it of the loads of this test.

    A mass m at the tip needs the torques m J'(q) g, of which a share `limits.unexplained_torque` of each joint's limit may be.
    """
    q_rad = _solved(solver_of(arm, cube), cube.poses()["P1"])
    per_kg = np.abs(np.array(arm.gravity_m_s2) @ ForwardKinematics(arm).jacobians([q_rad])[0])
    allowed_Nm = arm.limits.unexplained_torque * np.array([drive.torque_limit_Nm for drive in arm.drives])
    return float((allowed_Nm / np.maximum(per_kg, 1e-9)).min())


def plan(arm: Arm, cube: TestCube, extent: Extent, rated_m_s: float) -> Planned:
    """Solve every pose and plan every path; ArmError or Iso9283Error name the obstacle, and nothing moves."""
    if extent.rated_load_kg > (most_kg := largest_load_kg(arm, cube)):
        raise Iso9283Error(
            f"--rated-load-kg: expected at most {most_kg:.2f} kg, got {extent.rated_load_kg:g} kg: the loop would take more"
            " at P1 for a collision ([limits] unexplained_torque)"
        )
    solver = solver_of(arm, cube)
    todo = tuple(steps(cube, extent, rated_m_s))
    visits = [step for step in todo if isinstance(step, Visit)]
    tips = {p for v in visits for p in (v.tip_m, v.via_m) if p is not None}
    q_rad = {tip: _solved(solver, tip) for tip in tips}
    _require_clear(arm, list(q_rad.values()))
    paths: dict[tuple[Point, ...], dict[float, PlannedPath]] = {}
    inverse = InverseKinematics(arm)
    for step in todo:
        if isinstance(step, PathRun) and step.speed_m_s not in paths.setdefault(step.points_m, {}):
            near = _solved(solver, step.points_m[0])
            paths[step.points_m][step.speed_m_s] = plan_path(
                arm, step.points_m, step.speeds_m_s, q_near_rad=near, inverse=inverse
            )
    return Planned(programme_document(cube, extent, rated_m_s), todo, q_rad, paths)


def record(arm: Arm, bench: Bench, planned: Planned, out: Path, advance: Advance) -> None:
    """Run the plan; records go to `out`. Resumes an earlier recording of the same programme."""
    note_plan(out / "programme.json", planned.document, indent=2)
    n = arm.joint_count
    with (
        PointsWriter(out / "points.csv", n, more=SET) as points,
        contextlib.closing(KeptLines(out / "log.csv", Iso9283Error, ",".join(log_header(n)))) as log,
    ):
        runs = _Log(n, log)
        stops = remaining((_stop(planned, step) for step in planned.steps), points, runs)
        for done, stop in enumerate(tour(bench, HOW, stops, points, runs)):
            advance(stop.name, done / len(stops))
    advance("recorded", 1.0)


def _stop(planned: Planned, step: Step) -> Stop[Step]:
    if isinstance(step, PathRun):
        path = planned.paths[step.points_m][step.speed_m_s]
        name = f"{step.programme} at {step.speed_m_s:.3g} m/s, cycle {step.cycle}"
        return Stop(name, path, (tuple(path.q_start_rad),), run=step)
    return Stop(
        f"{step.setup}: {step.point}, {step.repeat}",
        planned.q_rad[step.tip_m],
        () if step.via_m is None else (planned.q_rad[step.via_m],),
        key=(step.setup, step.point, step.repeat),
        more={name: cell(value, 9) for name, value in zip(SET, step.tip_m, strict=True)},
        run=step if step.recorded else None,
        payload_kg=step.payload_kg,
        due_s=step.not_before_s if step.setup.startswith("drift_") else None,
    )


class _Log:
    """log.csv: of each run the rows with a camera frame, and a share of the others; of an approach all."""

    def __init__(self, joint_count: int, file: KeptLines) -> None:
        names = log_header(joint_count)
        rows = [dict(zip(names, line.decode(errors="replace").split(","), strict=False)) for line in file.lines]
        self._joint_count, self._file = joint_count, file
        self._ran = {(r["programme"], r["speed_m_s"], r["cycle"]) for r in rows}
        self._number = max((int(r["run"]) for r in rows), default=0)

    def has(self, run: Step) -> bool:
        """Whether a run is in the file."""
        return isinstance(run, PathRun) and (run.programme, cell(run.speed_m_s, 6), str(run.cycle)) in self._ran

    def keep(self, run: Step, rows: Rows) -> None:
        """Write the rows of a run."""
        is_path = isinstance(run, PathRun)
        name, cycle = (run.programme, run.cycle) if isinstance(run, PathRun) else (run.recorded, run.repeat)
        speed = cell(run.speed_m_s, 6) if isinstance(run, PathRun) else ""
        payload_kg = 0.0 if isinstance(run, PathRun) else run.payload_kg
        is_kept = np.isfinite(rows["x_m"]) if is_path else np.ones(len(rows), dtype=bool)
        is_kept[:: KEEP_EVERY if is_path else 1] = True
        self._number += 1
        joints = range(1, self._joint_count + 1)
        of_encoders = [form.format(j) for form in ("q{}_rad", "q{}_set_rad") for j in joints]
        of_joints = [column.replace("q", "joint", 1) for column in of_encoders]
        # without gear or encoder effects, joint angles equal encoder angles, and only those are recorded
        columns = of_encoders + (of_joints if of_joints[0] in (rows.dtype.names or ()) else of_encoders)
        start_s = float(rows["t_s"][0])
        self._file.append(
            *(
                ",".join(
                    [
                        str(self._number),
                        cell(float(row["t_s"]) - start_s, 6),
                        name,
                        str(cycle),
                        speed,
                        *(cell(float(row[column]), 9) for column in columns),
                        cell(payload_kg, 6),
                        *(cell(float(row[axis]), 7) for axis in TIP),
                    ]
                )
                for row in rows[is_kept]
            )
        )


def log_header(n: int) -> list[str]:
    """Columns of log.csv: those of the interchange format, and the programme of a run."""
    forms = ("q{}_rad", "q{}_set_rad", "joint{}_rad", "joint{}_set_rad")
    joints = [form.format(j) for form in forms for j in range(1, n + 1)]
    return ["run", "t_s", "programme", "cycle", "speed_m_s", *joints, "payload_kg", *TIP]


def _solved(solver: Solver, tip: Point) -> tuple[float, ...]:
    return solver(np.asarray(tip))


def _require_clear(arm: Arm, poses: Sequence[Sequence[float]]) -> None:
    """Iso9283Error if a joint move between any two of the poses takes the tip to the floor.

    From rest to rest, joint moves are straight lines in the space of the joints (control.motion.joint_move).
    """
    floor_m = arm.limits.floor_z_m + arm.limits.floor_clearance_m
    kinematics, shares = ForwardKinematics(arm), np.linspace(0.0, 1.0, _BETWEEN)[:, None]
    angles = np.unique(np.round(np.array(poses), 9), axis=0)
    for k, q in enumerate(angles):
        between = (q + shares[None] * (angles[k:, None, :] - q)).reshape(-1, arm.joint_count)
        lowest_m = float(kinematics.tips(between)[:, 2].min())
        if lowest_m < floor_m:
            raise Iso9283Error(
                f"arm {arm.name}: a joint move between test poses could take the tip to z = {lowest_m:.3f} m, below"
                f" the floor at {floor_m:g} m: choose a higher cube (--cube-centre, --cube-edge)"
            )


@dataclass(frozen=True, slots=True)
class RecordedFiles:
    """What is evaluated: poses, runs, poses of other arms, programme.json; `is_as_given`: units are as the columns say."""

    points: Path
    logs: Sequence[Path] = ()
    others: Sequence[Path] = ()
    programme: Path | None = None
    is_as_given: bool = False

    @property
    def inputs(self) -> Iterator[InputFile]:
        """The files that the result depends on."""
        yield input_file(self.points, "poses")
        yield from (input_file(log, "runs") for log in self.logs)
        yield from (input_file(other, "poses of another arm") for other in self.others)
        if self.programme is not None:
            yield input_file(self.programme, "test programme")


def evaluate_files(
    arm: Arm, files: RecordedFiles, band_m: float | None, out: Path, notes: Sequence[str] = ()
) -> tuple[Evaluation, tuple[str, ...]]:
    """Evaluate, write iso9283.json and iso9283.html into `out`; returns the evaluation and warnings about the files."""
    require_recorded_of(arm, files.points)
    groups, point_notes, warnings = _poses(files.points, arm, files.is_as_given)
    for log in files.logs:
        if log.suffix == ".armlog":
            raise Iso9283Error(f"{log}: a recording, expected log.csv: `armwright export {log} --out DIR` makes one")
    runs: list[RecordedRun] = [run for log in files.logs for run in read_runs(log, arm, files.is_as_given)]
    visited = {str(other): _poses(other, arm, files.is_as_given)[0] for other in files.others}
    corners = read_rectangle(files.programme) if files.programme is not None else None
    evaluation = evaluate(groups, runs, visited, corners, band_m, arm.joint_count, (*point_notes, *notes))
    made = made_today(*files.inputs)
    write_document(out / "iso9283.json", evaluation, arm.name, made)
    write_page(out / "iso9283.html", evaluation, arm.name, made)
    return evaluation, warnings


def _poses(path: Path, arm: Arm, is_as_given: bool) -> tuple[list[PoseGroup], tuple[str, ...], tuple[str, ...]]:
    if path.suffix == ".armlog":
        raise Iso9283Error(f"{path}: a recording, expected points.csv")
    points, warnings = read_points(path, also=BESIDE)
    groups, notes = pose_groups(replace(points, is_as_given=is_as_given), arm, path)
    return groups, notes, warnings
