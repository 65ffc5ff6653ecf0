"""Evaluates recorded files to iso9283.json and iso9283.html."""

import datetime
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

from calib.inputs import InputFile, input_file
from calib.iso9283.criteria.checks import Iso9283Error
from calib.iso9283.evaluation import evaluate
from calib.iso9283.page import write_page
from calib.iso9283.recorded import PoseGroup, Run, pose_groups, read_rectangle, read_runs
from calib.iso9283.result import Evaluation, write_document
from calib.points.arm_points import require_recorded_of
from calib.points.reading import read_points
from control.model.arm import Arm


def evaluate_files(
    arm: Arm,
    points: Path,
    logs: Sequence[Path],
    others: Sequence[Path],
    programme: Path | None,
    band_m: float | None,
    out: Path,
    notes: Sequence[str] = (),
    is_as_given: bool = False,
) -> tuple[Evaluation, tuple[str, ...]]:
    """Evaluate, write iso9283.json and iso9283.html into `out`; returns the evaluation and warnings about the files."""
    require_recorded_of(arm, points)
    groups, point_notes, warnings = _poses(points, arm, is_as_given)
    for log in logs:
        if log.suffix == ".armlog":
            raise Iso9283Error(
                f"{log}: a recording, expected log.csv: `armwright export {log} --out DIR` makes one"
            )
    runs: list[Run] = [run for log in logs for run in read_runs(log, arm, is_as_given)]
    visited = {str(other): _poses(other, arm, is_as_given)[0] for other in others}
    corners = read_rectangle(programme) if programme is not None else None
    found = evaluate(groups, runs, visited, corners, band_m, arm.joint_count, (*point_notes, *notes))
    inputs = [
        input_file(points, "poses"),
        *(input_file(log, "runs") for log in logs),
        *(input_file(other, "poses of another arm") for other in others),
        *([input_file(programme, "test programme")] if programme is not None else []),
    ]
    _write(arm, found, inputs, out)
    return found, warnings


def _poses(
    path: Path, arm: Arm, is_as_given: bool
) -> tuple[list[PoseGroup], tuple[str, ...], tuple[str, ...]]:
    if path.suffix == ".armlog":
        raise Iso9283Error(f"{path}: a recording, expected points.csv")
    points, warnings = read_points(path)
    groups, notes = pose_groups(replace(points, is_as_given=is_as_given), arm, str(path))
    own = ("_set_m", "_set_rad", "a_rad", "b_rad", "c_rad", "_N")
    unknown = [n for n in points.extra if not n.endswith(own) and not n.endswith("_sd_rad")]
    return groups, notes, warnings if unknown else ()


def _write(arm: Arm, found: Evaluation, inputs: Sequence[InputFile], out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    program = f"armwright {version('armwright')}"
    about = {
        "arm": arm.name,
        "date": date,
        "program_version": program,
        "inputs": {entry.name: entry.sha256 for entry in inputs},
    }
    write_document(out / "iso9283.json", found, about)
    write_page(out / "iso9283.html", found, arm.name, date, program, inputs)
