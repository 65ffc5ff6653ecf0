"""`armwright calibrate-distances`: an arm from lengths that draw wires, dial gauges or ball bars have measured."""

import argparse
import datetime
import sys
from importlib.metadata import version
from pathlib import Path

from calib.arm_problem.assembly import Choice
from calib.calibration.outcome import write_calibrated_arm, write_calibration_json
from calib.distances.calibrate import DistancePlan, calibrate_with_distances, distances_json, distances_text
from calib.identify.objective import objective_named
from calib.inputs import input_file
from calib.points.arm_points import points_for
from console.commands.calibration.options import bounds_of, names_in, wires_at
from console.commands.progress import Bar
from control.errors import ArmError
from control.model.description import load_arm
from procedures.folders import require_writable

RESULTS = ("arm.toml", "calibration.json")


def run(given: argparse.Namespace) -> int:
    """Read, identify, write. Nothing is written before all input has been read and checked."""
    arm, out, file = load_arm(given.arm), Path(given.out), Path(given.points)
    for name in RESULTS:
        if (out / name).exists():
            raise ArmError(f"{out / name} exists already and is never overwritten: choose another --out")
    require_writable(out)
    choice = Choice(
        bounds=bounds_of(given.bound or []),
        fixed=names_in(given.fix or []),
        freed=("tool",) if given.free_tool else (),
    )
    plan = DistancePlan(
        choice, given.free_zero, wires_at(given.wire_at or []), objective_named(given.objective)
    )
    points, warnings = points_for(arm, [file])
    for warning in warnings:
        sys.stderr.write(f"armwright: warning: {warning}\n")
    with Bar("calibrate-distances") as bar:
        made = calibrate_with_distances(arm, points, file, plan, bar.advance)
    files = [out / name for name in RESULTS]
    inputs = {file.name: input_file(file, "lengths").sha256}
    if arm.path is not None:
        inputs[arm.path.name] = input_file(arm.path, "the nominal arm").sha256
    date, program = (
        datetime.datetime.now(datetime.UTC).date().isoformat(),
        f"armwright {version('armwright')}",
    )
    out.mkdir(parents=True, exist_ok=True)
    write_calibrated_arm(files[0], arm, made.found, inputs, date, program, points)
    more = distances_json(made)
    write_calibration_json(files[1], arm.name, made.found, inputs, date, program, more=more)
    if given.json:
        sys.stdout.write(files[1].read_text(encoding="utf-8"))
    else:
        sys.stdout.write(distances_text(made) + "\n" + "".join(f"written: {one}\n" for one in files))
    return 0
