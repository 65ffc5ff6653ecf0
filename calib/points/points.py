"""points.csv: static poses in the interchange format, as arrays and as read from files.

Required columns: setup, point, repeat, q1_rad ... qn_rad. Optional: t_s, payload_kg, dir1 ..., i1_A ..., x_m, y_m, z_m
(empty where nothing was measured), beside them qw, qx, qy, qz, and covariances of both. Other columns are kept as text and
warned about. Comma-separated, .csv or .csv.gz.

An error of reading names file, line and column. Files that were recorded with another arm are refused.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, frozen
from calib.errors import PointsFileError, UnusablePointsError
from control.files import parsed_json, read_text
from control.model.arm import Arm
from control.tables import WHOLE_LARGEST, ColumnGroup, TableColumn, TableContent, TableFormat, Wrong, read_table

REQUIRED = ("setup", "point", "repeat")
TIP = ("x_m", "y_m", "z_m")
ORIENTATION = ("qw", "qx", "qy", "qz")
SCALARS = ("t_s", "payload_kg")
ARRAYS = ("q_rad", "tip_m", "direction", "current_A", *SCALARS, "orientation", "covariance")  # of all poses
# In the column `frame`: positions and orientations are in a frame of unknown place, of a camera (files of
# `armwright camera`), or of the arm's [camera.stream], which a calibration then places.
CAMERA_FRAME, STREAM_FRAME = OWN_FRAMES = ("camera", "stream")
TURNS_LIMIT_rad = 6 * math.pi  # no joint turns more than three times
FREE = "free"  # in the column `setup`: poses away from any board


@dataclass(frozen=True, slots=True, repr=False)
class Points:
    """m static poses of an arm with n joints; arrays are read-only.

    q_rad (m, n) from the encoders; tip_m (m, 3) in the base frame, NaN where not measured; direction (m, n)
    sign of each joint's last motion, 0 unknown; current_A (m, n), t_s (m,), payload_kg (m,): NaN where
    unknown. orientation (m, 4): unit quaternion w, x, y, z of the measured target in the same frame as tip_m, NaN where not
    measured. covariance (m, 12): of the position and of the orientation, upper triangles as in calib.points.points, NaN where
    unknown. `extra` holds columns beyond the format, as text. is_as_given: the user said that the file means what it says,
    whatever it looks like (`calib.arm_problem.misread`). began_s: when the recording began of which these are poses, by
    default the earliest of them, NaN without times. lines (m,): of the poses in their file, for errors.
    """

    setup: tuple[str, ...]
    point: tuple[str, ...]
    repeat: tuple[int, ...]
    q_rad: Array
    tip_m: Array
    direction: Array
    current_A: Array
    t_s: Array
    payload_kg: Array
    extra: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: MappingProxyType({}))
    orientation: Array = field(default_factory=lambda: frozen(np.zeros((0, 4))))  # empty: none was measured
    covariance: Array = field(default_factory=lambda: frozen(np.zeros((0, 12))))  # empty: none is known
    is_as_given: bool = False
    began_s: float = math.nan
    lines: npt.NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))  # empty: from 2

    def __repr__(self) -> str:
        """In one line: an interactive session prints what an expression gives."""
        tips = int(np.isfinite(self.tip_m[:, 0]).sum())
        setups = ", ".join(dict.fromkeys(self.setup))
        return f"<Points: {len(self.q_rad)} poses of {self.q_rad.shape[1]} joints, {tips} measured tips, setups {setups}>"

    def __post_init__(self) -> None:
        """Without any orientation or covariance, a row of NaN for each pose."""
        if not len(self.lines):
            object.__setattr__(self, "lines", np.arange(2, len(self.setup) + 2))
        if math.isnan(self.began_s) and np.isfinite(self.t_s).any():
            object.__setattr__(self, "began_s", float(np.nanmin(self.t_s)))
        for name, width in (("orientation", 4), ("covariance", 12)):
            if not len(getattr(self, name)):
                object.__setattr__(self, name, _known(None, (len(self.setup), width)))

    def __len__(self) -> int:
        """Number of poses."""
        return len(self.setup)

    @property
    def joint_count(self) -> int:
        """N."""
        return int(self.q_rad.shape[1])

    @property
    def elapsed_s(self) -> Array:
        """Times (m,) since the recording began."""
        return np.asarray(self.t_s - self.began_s)

    @property
    def in_camera_frame(self) -> bool:
        """Whether tips and orientations are in the frame of a camera, whose place is unknown."""
        return not {*OWN_FRAMES}.isdisjoint(self.extra.get("frame", ()))

    def chosen(self, rows: Sequence[int] | npt.NDArray[np.intp]) -> Points:
        """The poses of these rows, in this order."""
        k = np.asarray(rows, dtype=np.intp)
        whole: dict[str, Any] = {name: _known(own := getattr(self, name)[k], own.shape) for name in ARRAYS}
        for name in REQUIRED:
            whole[name] = tuple(getattr(self, name)[row] for row in k.tolist())
        extra = {name: tuple(column[row] for row in k.tolist()) for name, column in self.extra.items()}
        return replace(self, **whole, extra=MappingProxyType(extra), lines=self.lines[k])


def make_points(
    setup: Sequence[str],
    point: Sequence[str],
    repeat: Sequence[int],
    q_rad: Array,
    tip_m: Array,
    direction: Array | None = None,
    current_A: Array | None = None,
    t_s: Array | None = None,
    payload_kg: Array | None = None,
    extra: Mapping[str, tuple[str, ...]] | None = None,
    orientation: Array | None = None,
    covariance: Array | None = None,
) -> Points:
    """Make points from arrays; missing values are NaN, missing directions 0."""
    m, n = np.shape(q_rad)
    return Points(
        tuple(setup),
        tuple(point),
        tuple(int(r) for r in repeat),
        frozen(q_rad),
        frozen(tip_m),
        frozen(np.zeros((m, n)) if direction is None else direction),
        _known(current_A, (m, n)),
        _known(t_s, (m,)),
        _known(payload_kg, (m,)),
        MappingProxyType(dict(extra or {})),
        _known(orientation, (m, 4)),
        _known(covariance, (m, 12)),
    )


def _known(values: npt.ArrayLike | None, shape: tuple[int, ...]) -> Array:
    """Read-only values; not a number, which then takes no memory, where none of them is known."""
    found = np.zeros(0) if values is None else np.asarray(values, dtype=np.float64)
    return np.broadcast_to(np.nan, shape) if np.isnan(found).all() else frozen(found)


def seen_again(keys: Iterable[object]) -> list[int]:
    """Positions of keys that probably occur again: only of these is a table needed, which takes half a kilobyte a key."""
    marks = np.fromiter((hash(key) for key in keys), dtype=np.int64)
    _, place, count = np.unique(marks, return_inverse=True, return_counts=True)
    return [int(row) for row in np.flatnonzero(count[place] > 1)]


def joined(parts: Sequence[Points]) -> Points:
    """Concatenate the poses of several files; columns beyond the format are kept if every file has them."""
    first, *others = parts
    if not others:
        return first
    shared = [name for name in first.extra if all(name in part.extra for part in others)]
    whole: dict[str, Any] = {name: tuple(word for part in parts for word in getattr(part, name)) for name in REQUIRED}
    for name in ARRAYS:
        own = np.concatenate([getattr(part, name) for part in parts])
        whole[name] = _known(own, own.shape)
    extra = {name: tuple(cell for part in parts for cell in part.extra[name]) for name in shared}
    return replace(
        first,
        **whole,
        extra=MappingProxyType(extra),
        is_as_given=all(part.is_as_given for part in parts),
        began_s=float(np.fmin.reduce([part.began_s for part in parts])),
        lines=np.concatenate([part.lines for part in parts]),
    )


# Covariances of measured poses as columns of a file: upper triangles, of the position and of the orientation's error.
#
# The orientation's error is the rotation vector e with R_measured = exp([e]) R_true, in the axes of the measuring frame.

_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
POSITION = tuple(f"cov_{'xyz'[i]}{'xyz'[j]}_m2" for i, j in _PAIRS)
TURN = tuple(f"cov_r{'xyz'[i]}r{'xyz'[j]}_rad2" for i, j in _PAIRS)
COVARIANCE = (*POSITION, *TURN)


def triangles(matrices: Array) -> Array:
    """Upper triangles (..., 6) of symmetric matrices (..., 3, 3)."""
    return np.stack([matrices[..., i, j] for i, j in _PAIRS], axis=-1)


def matrices_of(triangle: Array) -> Array:
    """Symmetric matrices (..., 3, 3) of upper triangles (..., 6)."""
    matrices = np.empty((*triangle.shape[:-1], 3, 3))
    for k, (i, j) in enumerate(_PAIRS):
        matrices[..., i, j] = matrices[..., j, i] = triangle[..., k]
    return matrices


def is_covariance(triangle: Array) -> bool:
    """Whether an upper triangle (6,) is of a positive definite matrix."""
    try:
        np.linalg.cholesky(matrices_of(triangle))
    except np.linalg.LinAlgError:
        return False
    return True


def require_radians(q_rad: Array, where: str = "") -> None:
    """UnusablePointsError for angles (m, n) beyond three turns: they are degrees or counts. `where` begins what is said."""
    reach = np.abs(q_rad).max(axis=0)
    if (largest := float(reach.max())) > TURNS_LIMIT_rad:
        raise UnusablePointsError(
            f"{where}q{int(reach.argmax()) + 1}_rad reaches {largest:.6g}, more than three turns: expected radians, not degrees"
            " or counts"
        )


IMPORT = ": `armwright import-points` reads it and makes a points.csv"
ORIENTATION_MEANING = (
    "measured orientation of a target on the last link, in the same frame: unit quaternion (length within 0.002; q and −q are"
    " the same); empty: not measured"
)
TIP_GROUPS = (
    ColumnGroup(TIP),
    ColumnGroup(ORIENTATION, beside=TIP, since="an orientation was measured there"),
    ColumnGroup(POSITION, beside=TIP, since="its covariance is given"),
    ColumnGroup(TURN, beside=ORIENTATION, since="its covariance is given"),
)
POINTS = TableFormat(
    "point",
    (
        TableColumn(
            "setup", "`normal`, `roll`, `pitch`, `free` or any name: one placement of the board", is_required=True, is_name=True
        ),
        TableColumn("point", "name of the cavity or pose", is_required=True, is_name=True),
        TableColumn("repeat", "whole number", is_required=True, is_whole=True, lower=-WHOLE_LARGEST, upper=WHOLE_LARGEST),
        TableColumn("q{}_rad", "encoder angles, through nominal ratio and zero", is_required=True),
        TableColumn("t_s", "time of the record"),
        TableColumn("payload_kg", "mass at the tip"),
        TableColumn(
            "dir{}",
            "sign of the joint's last motion before it stopped: -1, 0 (unknown), 1",
            is_whole=True,
            lower=-1.0,
            upper=1.0,
            expected="-1, 0 or 1",
        ),
        TableColumn("i{}_A", "motor current while holding"),
        *(TableColumn(name, "measured tip in the base frame; empty: the cavity is the reference") for name in TIP),
        *(TableColumn(name, ORIENTATION_MEANING) for name in ORIENTATION),
        *(
            TableColumn(
                name, "covariance of the tip. `calibrate` weights points by it; a point without one gets the arm's camera noise"
            )
            for name in POSITION
        ),
        *(
            TableColumn(name, "covariance of the orientation: of e in R_measured = exp([e]) R_true, axes of the same frame")
            for name in TURN
        ),
        TableColumn(
            "frame",
            "`camera`, `stream`: the frame of a camera, or of `[camera.stream]`, whose place `calibrate` finds; empty: the base"
            " frame",
            is_name=True,
        ),
    ),
    groups=TIP_GROUPS,
    unknown="kept",
    # added by our own sessions; kept like any other column, without a warning
    unwarned=r"q\d+_sd_rad|temperature\d+_C|approach|take|distance_(of|m|sd_m)|[xyz]_set_m",
    most_rows=1_000_000,  # they take 0.7 GB to calibrate; calibrations have hundreds
    too_many="expected static poses, one line each; a time series is a log.csv",
    separated=IMPORT,
)


def read_points(path: Path, joint_count: int | None = None, also: TableFormat | None = None) -> tuple[Points, tuple[str, ...]]:
    """Read the points of a file; also returns warnings. PointsFileError names file, line and column.

    also: columns beyond the format that the caller reads by `beyond`; they are not warned about.
    """
    known = (POINTS.unwarned, *(column.name.format(r"\d+") for column in (also.columns if also else ())))
    form = replace(POINTS, unwarned="|".join(known))
    table = read_table(path, form, PointsFileError, joint_count)
    points = make_points(
        table.words("setup"),
        table.words("point"),
        table.number("repeat").astype(int).tolist(),
        table.joints("q{}_rad"),
        table.numbers(*TIP),
        np.nan_to_num(table.joints("dir{}")) if "dir1" in table else None,
        table.joints("i{}_A"),
        table.number("t_s"),
        table.number("payload_kg"),
        {name: tuple(table.words(name)) for name in table.names if name in (*table.unknown, "frame")},
        table.quaternions(*ORIENTATION),
        table.numbers(*COVARIANCE),
    )
    for group in (POSITION, TURN):
        _require_covariances(table, group)
    return replace(points, lines=np.array(table.lines, dtype=np.intp)), table.warnings


def beyond(points: Points, path: Path, form: TableFormat, wrong: Wrong) -> TableContent:
    """The columns of `form` among those that the points keep as text, checked as those of the format are."""
    required = [column.name for column in form.columns if column.is_required]
    if required and not points.extra:
        raise wrong(f"{path}, line 1: required column {required[0]} is missing beside angles and tips")
    table = TableContent(path, form, wrong, tuple(points.extra), 1, points.joint_count)
    table.add([*zip(*points.extra.values(), strict=True)] or [()] * len(points), points.lines.tolist())
    return table


def _require_covariances(table: TableContent, names: Sequence[str]) -> None:
    """Positive definite matrices, where a line has one."""
    triangles = table.numbers(*names)
    for row in np.flatnonzero(np.isfinite(triangles).all(axis=1)).tolist():
        if not is_covariance(triangles[row]):
            numbers = ", ".join(f"{value:.3g}" for value in triangles[row])
            raise PointsFileError(
                f"{table.place(row)}: {names[0]} to {names[-1]}: expected a positive definite covariance, got {numbers}"
            )


RECORDS = ("session.json", "plan.json", "programme.json")  # files that our recordings write beside points.csv


def base_points_for(arm: Arm, files: Sequence[Path], what: str, is_as_given: bool = False) -> tuple[Points, tuple[str, ...]]:
    """As `points_for`, but UnusablePointsError for points in a camera's frame, which `what` cannot use."""
    points, warnings = points_for(arm, files, is_as_given)
    if points.in_camera_frame:
        raise UnusablePointsError(
            f"{what}: the points are in a camera's frame of unknown place: calibrate with them first, then give the calibrated"
            " arm.toml and the points_base.csv that `armwright calibrate` writes beside it"
        )
    return points, warnings


def points_for(arm: Arm, files: Sequence[Path], is_as_given: bool = False) -> tuple[Points, tuple[str, ...]]:
    """Read and concatenate the points of all files; also returns warnings. `is_as_given`: as of `Points`.

    PointsFileError names file, line and column; UnusablePointsError for a file of another arm. Users of the points
    check the values of the columns (`calib.arm_problem.checks.require_of_arm`).
    """
    for file in files:
        require_recorded_of(arm, file)
    read = [read_points(file, arm.joint_count) for file in files]
    _require_one_frame(files, [part for part, _ in read])
    whole = replace(joined([part for part, _ in read]), is_as_given=is_as_given)
    return whole, tuple(sentence for _, warnings in read for sentence in warnings)


def _require_one_frame(files: Sequence[Path], parts: Sequence[Points]) -> None:
    """UnusablePointsError for points of a camera's frame among others."""
    own = [name for part in parts for name in part.extra.get("frame", ()) if name in OWN_FRAMES]
    first = own[0] if own else ""
    for file, part in zip(files, parts, strict=True):
        frames = part.extra.get("frame", ("",) * len(part))
        if first and set(frames) != {first}:
            raise UnusablePointsError(
                f'{file}: points in a camera\'s frame (column frame: "{first}") and others cannot be used together: give'
                " the files of one frame"
            )


def require_recorded_of(arm: Arm, file: Path) -> None:
    """UnusablePointsError if the record beside the points names another arm."""
    for name in RECORDS:
        recorded = _arm_in(file.parent / name)
        if recorded is not None and recorded != arm.name:
            raise UnusablePointsError(
                f'{file}: expected points of arm "{arm.name}", got points of "{recorded}" according to {name} beside it: give'
                f' the file of "{recorded}" with --arm, or points of "{arm.name}"'
            )


def _arm_in(file: Path) -> str | None:
    """The arm's name in one of our files; None if it cannot be read."""
    try:
        content = parsed_json(read_text(file))
    except (OSError, ValueError):
        return None
    name = content.get("arm") if isinstance(content, dict) else None
    return name if isinstance(name, str) else None
