"""Reads recorded poses and runs for the criteria: points.csv and log.csv (docs/formats.md), and programme.json."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calib.arm_problem.assembly import Choice
from calib.arm_problem.checks import require_columns_meant, require_of_arm
from calib.arm_problem.observations import mean_rotation
from calib.arrays import Array, frozen
from calib.iso9283.pose_criteria import Iso9283Error
from calib.points.points import IMPORT, TIP, Points, beyond, make_points
from calib.results import array_in, read_json
from control.kinematics.kinematics import ForwardKinematics
from control.kinematics.rotation import logarithms, matrices
from control.model.arm import Arm
from control.tables import SAMPLES_MOST, ColumnGroup, TableColumn, TableContent, TableFormat, read_table

SET = ("x_set_m", "y_set_m", "z_set_m")
ANGLES, ANGLES_SET, FORCE = (("a_rad", "b_rad", "c_rad"), ("a_set_rad", "b_set_rad", "c_set_rad"), ("fx_N", "fy_N", "fz_N"))

TARGET_NOTE = "orientation: measured quaternions, with the target where it fits all commanded poses best"
CAMERA, ENCODERS = "camera", "encoders"
NO_LOG = "a recording of runs (--log with log.csv): "
STILL_m = 1e-9  # between two rows: a smaller change of the set-point is rest


BESIDE = TableFormat(
    "point",
    (
        *(TableColumn(name, "commanded tip", may_be_empty=False) for name in SET),
        *(TableColumn(name, "commanded orientation", may_be_empty=False) for name in ANGLES_SET),
        *(TableColumn(name, "measured orientation", may_be_empty=False) for name in ANGLES),
        *(TableColumn(name, "load at the tip", may_be_empty=False) for name in FORCE),
        TableColumn("joint{}_set_rad", "commanded joint angles", may_be_empty=False),
        TableColumn("q{}_set_rad", "commanded encoder angles", may_be_empty=False),
    ),
    groups=tuple(ColumnGroup(names) for names in (SET, ANGLES_SET, ANGLES, FORCE)),
)
"""Columns of a test that points.csv may have beside its own."""


@dataclass(frozen=True, slots=True)
class PoseGroup:
    """One pose of one programme: commanded (3,), attained (n, 3) in order of time, base frame, m.

    t_s (n,), force_N (n, 3) of the load at the tip; angle_set_rad (3,) and angle_rad (n, 3) if the orientation
    was measured. `unseen`: number of visits without a measured tip.
    """

    setup: str
    point: str
    commanded_m: Array
    attained_m: Array
    t_s: Array
    force_N: Array
    unseen: int = 0
    angle_set_rad: Array | None = None
    angle_rad: Array | None = None


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """One run: commanded tip set_m (k, 3) and encoder_m (k, 3), both by the arm's model, at time_s (k,).

    seen_m (s, 3) at seen_s (s,) by the camera. `programme` is empty and speed_m_s NaN if the file does not give them.
    """

    number: int
    programme: str
    cycle: int
    speed_m_s: float
    time_s: Array
    set_m: Array
    encoder_m: Array
    seen_s: Array
    seen_m: Array

    @property
    def is_moving(self) -> bool:
        """Whether the set-point moves at all."""
        return bool(self._moving.any())

    @property
    def _moving(self) -> npt.NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(np.diff(self.set_m, axis=0), axis=1) >= STILL_m)

    def measured(self, source: str) -> tuple[Array, Array]:
        """Times (k,) and positions (k, 3) by CAMERA or ENCODERS; Iso9283Error with too few camera frames."""
        if source == ENCODERS:
            return self.time_s, self.encoder_m
        if len(self.seen_m) < 3:
            raise Iso9283Error("a measured tip (x_m, y_m, z_m, by a camera)")
        return self.seen_s, self.seen_m

    @property
    def moving_s(self) -> tuple[float, float]:
        """Start and end of the set-point's motion."""
        moving = np.flatnonzero(self._moving)
        if not len(moving):
            raise Iso9283Error(f"run {self.number}: the set-point does not move")
        return float(self.time_s[moving[0]]), float(self.time_s[moving[-1] + 1])


def pose_groups(points: Points, arm: Arm, path: Path) -> tuple[list[PoseGroup], tuple[str, ...]]:
    """Poses by setup and point, in order, and the source of the commanded positions as text.

    UnusablePointsError for points in other units or of another arm.
    """
    table = beyond(points, path, BESIDE, Iso9283Error)
    commanded, source = _commanded(points, table, arm)
    measured = np.flatnonzero(np.isfinite(points.tip_m).all(axis=1))
    is_checked = len(measured) > 0 and points.joint_count == arm.joint_count
    warnings = require_of_arm(arm, points.chosen(measured)) if is_checked else ()
    weight_N = np.outer(np.nan_to_num(points.payload_kg), arm.gravity_m_s2)
    force = table.numbers(*FORCE) if FORCE[0] in table else weight_N
    angle_set, angle = (table.numbers(*names) if names[0] in table else None for names in (ANGLES_SET, ANGLES))
    if angle is None and points.joint_count == arm.joint_count:
        angle_set, angle = _turned(points, table, arm)
    turns = (TARGET_NOTE,) if angle is not None and ANGLES[0] not in table else ()
    keys = list(zip(points.setup, points.point, strict=True))
    groups = []
    for key in dict.fromkeys(keys):
        rows = np.array([k for k, other in enumerate(keys) if other == key])
        seen = rows[np.isfinite(points.tip_m[rows]).all(axis=1)]
        turned = None if angle is None or angle_set is None else _angles_of(angle_set, angle, rows)
        groups.append(
            PoseGroup(
                *key,
                frozen(commanded[rows].mean(axis=0)),
                frozen(points.tip_m[seen]),
                frozen(points.t_s[seen]),
                frozen(force[seen]),
                len(rows) - len(seen),
                *(turned or (None, None)),
            )
        )
    return groups, (source, *turns, *warnings)


def _angles_of(angle_set: Array, angle: Array, rows: npt.NDArray[np.intp]) -> tuple[Array, Array] | None:
    """Commanded (3,) and attained (n, 3) angles of one pose; None if none was measured there."""
    seen = rows[np.isfinite(angle[rows]).all(axis=1)]
    return (angle_set[seen].mean(axis=0), angle[seen]) if len(seen) else None


def _turned(points: Points, table: TableContent, arm: Arm) -> tuple[Array | None, Array | None]:
    """Angles (m, 3) about x, y, z of the base by which measured orientations are off the commanded ones, whose are 0.

    The target sits on the last link where it fits all poses best.
    """
    seen = np.flatnonzero(np.isfinite(points.orientation).all(axis=1))
    if not len(seen):
        return None, None
    q_rad, _ = _commanded_rad(points, table)
    commanded = ForwardKinematics(arm).link_transforms(q_rad[seen])[:, -1, :3, :3]
    measured = matrices(points.orientation[seen])
    target = mean_rotation(np.swapaxes(commanded, 1, 2) @ measured)
    angle = np.full((len(points), 3), np.nan)
    angle[seen] = logarithms(measured @ np.swapaxes(commanded @ target, 1, 2))
    return np.zeros_like(angle), angle


def _commanded(points: Points, table: TableContent, arm: Arm) -> tuple[Array, str]:
    """Commanded positions (m, 3): from columns, or by forward kinematics of set-points or encoders."""
    if SET[0] in table:
        return table.numbers(*SET), "commanded positions: columns x_set_m, y_set_m, z_set_m"
    if points.joint_count != arm.joint_count:
        raise Iso9283Error(
            f"{table.path}: no commanded positions: columns {', '.join(SET)} are missing, and arm {arm.name} has"
            f" {arm.joint_count} joints, the file {points.joint_count}: add the columns, or give the right --arm"
        )
    q_rad, source = _commanded_rad(points, table)
    tips_m = ForwardKinematics(arm).tips(q_rad)
    return tips_m, f"commanded positions: forward kinematics of arm {arm.name} at the {source}"


def _commanded_rad(points: Points, table: TableContent) -> tuple[Array, str]:
    """Commanded joint angles (m, n), and where they are from."""
    for form in ("joint{}_set_rad", "q{}_set_rad"):
        if form.format(1) in table:
            return table.joints(form), "set-points"
    return points.q_rad, "encoder angles at rest"


RUNS = TableFormat(
    "sample",
    (
        TableColumn("run", "number of the run; empty: 0", is_required=True, may_be_empty=True, is_whole=True),
        TableColumn("t_s", "time", is_required=True),
        TableColumn("q{}_rad", "encoder angles", is_required=True),
        TableColumn("q{}_set_rad", "set-points; empty: none", is_required=True, may_be_empty=True),
        TableColumn("joint{}_rad", "joint angles, where they differ from the encoders'", may_be_empty=False),
        TableColumn("joint{}_set_rad", "their set-points"),
        TableColumn("programme", "what the run is of", is_name=True),
        *(TableColumn(name, "of the programme") for name in ("cycle", "speed_m_s")),
        *(TableColumn(name, "measured tip, base frame; empty between camera frames") for name in TIP),
    ),
    unwarned=".*",
    most_rows=SAMPLES_MOST,
    separated=IMPORT,
)


def read_runs(path: Path, arm: Arm, is_as_given: bool = False) -> list[RecordedRun]:
    """Every run of a log.csv or log.csv.gz; Iso9283Error names file, line and column.

    Rows without a set-point, such as during hand guiding, are omitted. `is_as_given`: its units are not doubted.
    """
    table, kinematics = read_table(path, RUNS, Iso9283Error, arm.joint_count), ForwardKinematics(arm)
    # with gear or encoder effects in the model, the tip follows joint angles, not encoder angles
    encoders = not ("joint1_rad" in table and "joint1_set_rad" in table)
    q_rad, wanted_rad = (
        table.joints(form) for form in (("q{}_rad", "q{}_set_rad") if encoders else ("joint{}_rad", "joint{}_set_rad"))
    )
    number, time_s, tip_m = np.nan_to_num(table.number("run")), table.number("t_s"), table.numbers(*TIP)
    has_wanted = np.asarray(np.isfinite(wanted_rad).all(axis=1))
    runs: list[RecordedRun] = []
    for run in dict.fromkeys(number.tolist()):
        of_run = np.flatnonzero(number == run)
        rows = of_run[has_wanted[of_run]]
        if len(rows) < 2:
            continue
        if not runs:  # the columns of one run are those of all
            _require_meant(arm, q_rad[rows], tip_m[rows], is_as_given)
        rows = rows[np.argsort(time_s[rows], kind="stable")]
        rows = rows[np.concatenate(([True], np.diff(time_s[rows]) > 0.0))]
        seen = rows[np.isfinite(tip_m[rows]).all(axis=1)]
        first = int(of_run[0])
        runs.append(
            RecordedRun(
                int(run),
                table.words("programme")[first],
                int(np.nan_to_num(table.number("cycle")[first])),
                float(table.number("speed_m_s")[first]),
                frozen(time_s[rows]),
                frozen(kinematics.tips(wanted_rad[rows])),
                frozen(kinematics.tips(q_rad[rows])),
                frozen(time_s[seen]),
                frozen(tip_m[seen]),
            )
        )
    if not runs:
        raise Iso9283Error(f"{path}: expected recorded runs of two rows or more with set-points, got none")
    return runs


def _require_meant(arm: Arm, q_rad: Array, tip_m: Array, is_as_given: bool) -> None:
    """UnusablePointsError if angles are not in radians or tips not in metres."""
    m = len(q_rad)
    points = replace(make_points(["run"] * m, [""] * m, [1] * m, q_rad, tip_m), is_as_given=is_as_given)
    require_columns_meant(arm, points, Choice().for_points(arm, points))


def read_rectangle(path: Path) -> tuple[Array, ...]:
    """The corners E1 .. E4 of programme.json."""
    document = read_json(path, "iso9283-programme/1", Iso9283Error)
    return tuple(array_in(f"{path}, rectangle_m", document.get("rectangle_m"), (4, 3), Iso9283Error))
