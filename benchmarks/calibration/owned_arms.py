"""What an afternoon makes of the arms that people own, on the mock. `make owned-arms-study`: docs/arms.md, docs/so101.md.

An arm as printed and put together at home (scenario so101: geometry 1 mm and 1 deg off, zeros 2 deg), with play as published.
A camera of 0.5 mm sees the tip, in the base frame, in 40 poses to calibrate with and in 25 others to look at. Every model says
where the tip is by encoders, directions of the last motion and currents: as published, with the zeros alone identified, with all
of the geometry, with what `gap` names besides; and by the exported URDF of the last, which knows no play.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from armwright import Points, RequestRefused, calibrate, find_gap, load_arm, make_points, verify
from armwright.mock import mock_arm
from benchmarks.studies import add_options
from calib.arm_import import arm_links, read_arm
from calib.arrays import Array
from calib.design.candidates import joint_box, spread_poses
from calib.export import export_text
from calib.studies.cluster import executor
from control.model.arm import Arm, Camera
from hil_mocks.scenario import EveryJoint, load_scenario
from procedures.mock import scenario_bytes

# Play of each joint [deg], and whose figure it is.
PLAYS = {
    "so101": {0.5: "data sheet, at most", 1.0: "the project's simulation", 1.3: "owners"},
    "koch": {0.25: "data sheet of the larger XM430", 1.0: "as an SO-101"},
}
FRICTION = 0.03  # of the stall torque, where none is published
NOISE_m = 5e-4
CALIBRATED, SEEN = 40, 25
SETTLE_s, AVERAGE_s = 0.6, 0.3
MODELS = ("as published", "zeros alone", "calibrated", "with what gap named", "its exported URDF")


@dataclass(frozen=True)
class Afternoon:
    """Tip errors (5, 25) [m] of MODELS in poses that nothing was fitted to, and what `gap` named."""

    arm: str
    play_deg: float
    error_m: Array
    named: tuple[str, ...]


def afternoon(
    name: str, play_deg: float, seed: int, calibrated: int = CALIBRATED, seen: int = SEEN
) -> Afternoon:
    """One arm, made from a seed."""
    arm = replace(load_arm(name), camera=Camera(position_noise_m=NOISE_m))
    points = _recorded(arm, play_deg, seed, calibrated + seen)
    fitted, others = points.chosen(range(calibrated)), points.chosen(range(calibrated, calibrated + seen))
    lengths = [f"{key}{i}" for i in range(1, len(arm.links) + 1) for key in ("d", "L", "alpha")]
    zeros = calibrate(arm, fitted, fixed=("base", *lengths)).arm
    whole = calibrate(arm, fitted, fixed=("base",)).arm
    gap = find_gap(whole, fitted)
    with tempfile.TemporaryDirectory() as folder:
        named = gap.save(Path(folder) / "gap")
    models = (arm, zeros, whole, named, _of_urdf(named))
    errors = [np.linalg.norm(verify(arm, model, others).after_m, axis=1) for model in models]
    return Afternoon(name, play_deg, np.array(errors), gap.named)


def afternoon_of(sort: tuple[str, float], number: int) -> Afternoon:
    """`afternoon`, as a task of a study."""
    return afternoon(*sort, number)


def _recorded(arm: Arm, play_deg: float, seed: int, count: int) -> Points:
    """Static poses all over the range, moved to one after the other; the tip in the base frame, as a camera sees it."""
    home_made = load_scenario("so101")
    has_friction = any(effect.effect == "coulomb_friction" for effect in arm.effects)
    every = EveryJoint(0.0 if has_friction else FRICTION, 0.0, math.radians(play_deg))
    hidden = msgspec.structs.replace(home_made, seed=seed, every_joint=every)
    rng = np.random.default_rng(seed)
    q_rad, tip_m, current_A, direction = [], [], [], []
    with tempfile.TemporaryDirectory() as folder:
        scenario = Path(folder) / "hidden.toml"
        scenario.write_bytes(scenario_bytes(hidden))
        with mock_arm(arm, scenario) as running:
            running.enable()
            for pose in spread_poses(joint_box(arm, margin_rad=0.2), 20 * count):
                try:
                    running.move_joints(pose)
                except RequestRefused:  # it, or the way there, is below the floor
                    continue
                running.wait(SETTLE_s)
                average = running.measure(AVERAGE_s)
                q_rad.append(average.q_rad)
                current_A.append(average.current_A)
                direction.append(average.direction)
                tip_m.append(running.true_tip_m() + rng.normal(0.0, NOISE_m, 3))
                if len(tip_m) == count:
                    break
    return make_points(q_rad, tip_m, direction=direction, current_A=current_A, payload_kg=np.zeros(count))


def _of_urdf(arm: Arm) -> Arm:
    """What another program loads: the links of the exported URDF alone."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "exported.urdf"
        file.write_text(export_text(arm, "urdf"), encoding="utf-8")
        serial = read_arm(file, "urdf", None, None)
    links, _ = arm_links(serial, "standard")
    return replace(arm, links=links, effects=(), maps=(), tool=type(arm.tool)())


def main() -> None:
    """Print a table of every arm and play: mean and largest error over all seeds, and how often each effect was named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=1, help="arms of each sort")
    add_options(parser)
    given = parser.parse_args()
    sorts = [(name, play_deg) for name, plays in PLAYS.items() for play_deg in plays]
    with executor(len(sorts) * given.cases, given.workers, given.cluster) as runs:
        for sort in sorts:
            found = [made for _, made in runs.results(afternoon_of, sort, range(given.cases))]
            sys.stdout.writelines(f"{line}\n" for line in lines(found))
            sys.stdout.flush()


def lines(found: list[Afternoon]) -> Iterator[str]:
    """The table of arms of one sort."""
    name, play = found[0].arm, found[0].play_deg
    yield f"{name}, play of {play:g} deg ({PLAYS[name][play]}), {len(found)} arms"
    errors_mm = 1e3 * np.concatenate([one.error_m for one in found], axis=1)
    for model, error_mm in zip(MODELS, errors_mm, strict=True):
        yield f"  {model:<22}{error_mm.mean():6.2f} mm mean{error_mm.max():7.2f} mm largest"
    yield f"  named: {'; '.join(', '.join(one.named) or 'nothing' for one in found)}"


if __name__ == "__main__":
    main()
