"""`armwright calibrate`: from recorded points to a calibrated arm with its uncertainty."""

import argparse
import sys
from pathlib import Path

from calib.ageing import geometry_of
from calib.arm_problem.assembly import Choice
from calib.calibration.calibrate import Calibrated, CalibrationPlan, LeaveOut, calibrate, points_in_base
from calib.calibration.outcome import write_calibrated_arm, write_calibration_json
from calib.calibration.report import calibration_report, judgement_json, summary_text
from calib.errors import CalibrationError
from calib.export import FORMS, export
from calib.identify.objective import objective_named
from calib.points.arm_points import points_for
from calib.points.points import Points
from calib.points.writer import write_points
from calib.report.report import write_report
from calib.results import InputFile, input_file, made_today
from console.commands.calibration.options import (
    board_frames,
    bounds_of,
    names_in,
    orientation_noise_rad,
    quantity,
    record_of,
)
from console.commands.progress import Bar, answer, warn
from control.model.arm import Arm
from control.model.description import load_arm
from procedures.folders import require_new

ENDINGS = {"urdf": "urdf", "mjcf": "xml", "json": "json"}
BASE_POINTS = "points_base.csv"
RESULTS = ("arm.toml", "calibration.json", "report.html", BASE_POINTS)


def run(given: argparse.Namespace) -> int:
    """Read, identify, validate, write. Nothing is written before all input has been read and checked."""
    arm, out, forms = load_arm(given.arm), Path(given.out), _forms(given.export or [])
    require_new(out, (*RESULTS, *(f"arm.{ENDINGS[form]}" for form in forms)))
    record = record_of(given, "calibrate", arm.name)
    plan = _plan(given)
    points, warnings = _read(given, arm)
    with Bar("calibrate") as bar:
        made = calibrate(arm, points, plan, bar.advance)
    warn((*warnings, *made.warnings))
    files = _write(given, made, out, forms)
    if record is not None:
        record.append(made_today(*_inputs(given, arm)).hashes, geometry_of(made.problem, made.found))
    answer(given, files["for programs"], summary_text(made), files)
    return 0


def _forms(texts: list[str]) -> list[str]:
    """The requested export formats; CalibrationError for an unknown one."""
    forms = names_in(texts)
    for form in forms:
        if form not in FORMS:
            raise CalibrationError(f'--export: expected one or more of {", ".join(FORMS)}, got "{form}"')
    return forms


def _read(given: argparse.Namespace, arm: Arm) -> tuple[Points, tuple[str, ...]]:
    """The points of all files, without those that the operator omits."""
    points, warnings = points_for(arm, [Path(name) for name in given.points], given.as_given)
    if "distance_of" in points.extra:
        raise CalibrationError(
            "the points have lengths (column distance_of): calibrate with `armwright calibrate-distances`, which uses measured"
            " tips, too"
        )
    left_out = _rows_of(points, given.without or [])
    if left_out:
        points = points.chosen([k for k in range(len(points)) if k not in left_out])
    return points, warnings


def _rows_of(points: Points, names: list[str]) -> set[int]:
    """Rows named as SETUP, SETUP:POINT or SETUP:POINT:REPEAT; CalibrationError if there are none."""
    found: set[int] = set()
    for name in names:
        wanted = name.split(":")
        rows = {
            k
            for k, row in enumerate(zip(points.setup, points.point, map(str, points.repeat), strict=True))
            if list(row[: len(wanted)]) == wanted
        }
        if not rows or len(wanted) > 3:
            raise CalibrationError(
                f'--without "{name}": no such pose; expected SETUP, SETUP:POINT or SETUP:POINT:REPEAT, with a setup'
                f" of {', '.join(dict.fromkeys(points.setup))}"
            )
        found |= rows
    return found


def _plan(given: argparse.Namespace) -> CalibrationPlan:
    """The calibration plan of the options."""
    threshold_m = quantity(given.huber_threshold, "m", "--huber-threshold") if given.huber_threshold else None
    accuracy_m = quantity(given.accuracy, "m", "--accuracy") if given.accuracy else None
    if accuracy_m is not None and accuracy_m <= 0.0:
        raise CalibrationError(f"--accuracy: expected a length above 0, got {given.accuracy}")
    choice = Choice(
        bounds=bounds_of(given.bound or []),
        fixed=names_in(given.fix or []),
        freed=names_in(given.free or []),
        boards=board_frames(given.boards),
        effects=tuple(names_in(given.effect or [])),
        orientation_noise_rad=orientation_noise_rad(given.orientation_noise),
    )
    return CalibrationPlan(
        choice,
        objective_named(given.objective, threshold_m),
        accuracy_m,
        _leave_out(given.leave_out),
        given.starts,
        given.seed,
    )


def _leave_out(text: str | None) -> LeaveOut:
    if text is None:
        return None
    if text == "setups":
        return "setup"
    if text.isdigit() and int(text) >= 2:
        return int(text)
    raise CalibrationError(
        f'--leave-out: expected "setups", or k from 2 on for every k-th point, got "{text}"'
    )


def _write(given: argparse.Namespace, made: Calibrated, out: Path, forms: list[str]) -> dict[str, Path]:
    """Write the calibrated arm, calibration.json, report.html and the exports; return the files by kind."""
    provenance = made_today(*_inputs(given, made.nominal))
    files = {"calibrated arm": out / "arm.toml", "for programs": out / "calibration.json"}
    write_calibrated_arm(files["calibrated arm"], made.nominal, made.found, provenance, made.points)
    more = judgement_json(made)
    write_calibration_json(files["for programs"], made.nominal.name, made.found, provenance, more=more)
    in_base = points_in_base(made)
    if in_base is not None:
        files["points in the base frame"] = out / BASE_POINTS
        write_points(files["points in the base frame"], in_base)
    files["report"] = out / "report.html"
    write_report(files["report"], calibration_report(made, provenance))
    for form in forms:
        files[form] = out / f"arm.{ENDINGS[form]}"
        for sentence in export(made.arm, form, files[form]):
            sys.stderr.write(f"armwright: note: {sentence}\n")
    return files


def _inputs(given: argparse.Namespace, arm: Arm) -> tuple[InputFile, ...]:
    """Every file that the result depends on."""
    found = [input_file(Path(name), "points: joint angles and tip measurements") for name in given.points]
    if arm.path is not None:
        found.append(input_file(arm.path, "the nominal arm"))
    if given.boards is not None:
        found.append(input_file(Path(given.boards), "measured board poses"))
    return tuple(found)
