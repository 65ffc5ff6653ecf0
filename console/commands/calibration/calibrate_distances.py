"""`armwright calibrate-distances`: an arm from lengths that draw wires, dial gauges or ball bars have measured."""

import argparse
from pathlib import Path

from calib.arm_problem.assembly import Choice
from calib.calibration.outcome import write_calibrated_arm, write_calibration_json
from calib.distances.calibrate import DistancePlan, calibrate_with_distances, distances_json, distances_text
from calib.identify.objective import objective_named
from calib.points.arm_points import points_for
from calib.results import input_file, made_today
from console.commands.calibration.options import bounds_of, names_in, wires_at
from console.commands.progress import Bar, answer, warn
from control.model.description import load_arm
from procedures.folders import require_new

RESULTS = ("arm.toml", "calibration.json")


def run(given: argparse.Namespace) -> int:
    """Read, identify, write. Nothing is written before all input has been read and checked."""
    arm, out, file = load_arm(given.arm), Path(given.out), Path(given.points)
    require_new(out, RESULTS)
    choice = Choice(
        bounds=bounds_of(given.bound or []),
        fixed=names_in(given.fix or []),
        freed=("tool",) if given.free_tool else (),
    )
    plan = DistancePlan(
        choice, given.free_zero, wires_at(given.wire_at or []), objective_named(given.objective)
    )
    points, warnings = points_for(arm, [file])
    warn(warnings)
    with Bar("calibrate-distances") as bar:
        made = calibrate_with_distances(arm, points, file, plan, bar.advance)
    files = [out / name for name in RESULTS]
    nominal = [] if arm.path is None else [input_file(arm.path, "the nominal arm")]
    provenance = made_today(input_file(file, "lengths"), *nominal)
    write_calibrated_arm(files[0], arm, made.found, provenance, points)
    write_calibration_json(files[1], arm.name, made.found, provenance, more=distances_json(made))
    answer(given, files[1], distances_text(made) + "\n" + "".join(f"written: {one}\n" for one in files))
    return 0
