"""Reading points.csv: the declaration of its columns, and `Points` of a file, or of all files of one arm; an error names file,
line and column. Files that were recorded with another arm are refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.errors import PointsFileError, UnusablePointsError
from calib.points.points import (
    COVARIANCE,
    ORIENTATION,
    OWN_FRAMES,
    POSITION,
    TIP,
    TURN,
    Points,
    is_covariance,
    joined,
    make_points,
)
from control.files import parsed_json, read_text
from control.model.arm import Arm
from control.tables import WHOLE_LARGEST, ColumnGroup, TableColumn, TableContent, TableFormat, Wrong, read_table

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
