"""Reads and joins the points of one arm, and refuses files that were recorded with another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from calib.errors import UnusablePointsError
from calib.points.points import OWN_FRAMES, Points, joined
from calib.points.reading import read_points
from control.files import parsed_json, read_text
from control.model.arm import Arm

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
