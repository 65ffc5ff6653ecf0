"""What an afternoon makes of the arms that people own, on the mock. `make owned-arms-study`: docs/arms.md and their pages.

An arm as printed and put together at home (scenario so101: geometry 1 mm and 1 deg off, zeros 2 deg; with `--small` 0.3 mm,
0.3 deg and 1 deg), with play as published. A camera of 0.5 mm sees the tip, in the base frame, in 40 poses to calibrate with and
in 25 others to look at. Every model says where the tip is by encoders, directions of the last motion and currents: as published,
with the zeros alone identified, with all of the geometry as if nobody knew how exactly parts are made, as `calibrate` does it,
with what `gap` names besides; and by the exported URDF of the last, which knows play on average only.

With `--webcam` pictures stand in the camera's place: a board on the jaw, rendered with lens distortion, blur and noise, goes
through the detector, and neither the lens nor the places of camera and board are known. The errors are then those of the
board's centre against the truth, both sets placed where they fit best.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from armwright import Points, RequestRefused, calibrate, find_gap, load_arm, make_points, verify
from armwright.mock import mock_arm
from benchmarks.studies import add_options
from calib.arm_import import arm_links, read_arm
from calib.arm_problem.assembly import with_own_base
from calib.arm_problem.observations import rotation_of
from calib.arrays import Array, norms
from calib.boards import best_motion
from calib.calibration import points_in_base
from calib.design.candidates import joint_box, spread_poses
from calib.export import exported
from calib.studies import executor
from calib.vision.intrinsics import CORNERS_LEAST as LENS_CORNERS
from calib.vision.intrinsics import fit_lens
from calib.vision.poses import CORNERS_LEAST, CameraPictures, measure_poses, picture_name, with_pictures
from calib.vision.targets import Charuco, look_for, picture_files, png_of
from control.errors import ArmError
from control.model.arm import Arm, Camera, Tool
from hil_mocks.arm_pictures import FramePose, PicturedArm, Webcam, looking_at
from hil_mocks.scenario import EveryJoint, Scenario, TrueDh, load_scenario
from procedures.demo.webcam import DOTS_A_METRE, MARGIN_m, is_inside, photograph_board
from procedures.mock import scenario_bytes

# Play of each joint [deg], and whose figure it is.
PLAYS = {
    "so101": {0.5: "data sheet, at most", 1.0: "the project's simulation", 1.3: "owners"},
    "so100": {1.0: "as an SO-101"},
    "koch": {0.25: "data sheet of the larger XM430", 1.0: "as an SO-101"},
    "widowx250": {0.25: "data sheet of the XM430"},
    "openmanipulatorx": {0.25: "data sheet of the XM430"},
    "viperx300s": {0.25: "data sheet of the XM540"},
}
FRICTION = 0.03  # of the stall torque, where none is published
NOISE_m = 5e-4
CALIBRATED, SEEN = 40, 25
SETTLE_s, AVERAGE_s = 0.6, 0.3
# Fixed to the jaw, and beside the arm.
BOARD = Charuco(5, 7, 0.015, 0.01125)
BOARD_OFF_m, MOUNT_rad = (0.004, -0.006, 0.01), (0.0, 0.5 * math.pi, 0.0)
CAMERA_m, VIEW_m = (0.75, 0.15, 0.35), (0.2, 0.0, 0.15)
FACING, FARTHEST_m = 0.5, 0.75
SMALL = TrueDh(d_m=3e-4, theta_rad=math.radians(1.0), L_m=3e-4, alpha_rad=math.radians(0.3))
MODELS = ("as published", "zeros alone", "without tolerances", "calibrated", "with what gap named", "its exported URDF")


@dataclass(frozen=True)
class Afternoon:
    """Tip errors (6, 25) [m] of MODELS in poses that nothing was fitted to, and what `gap` named."""

    arm: str
    play_deg: float
    error_m: Array
    named: tuple[str, ...]


def afternoon(name: str, play_deg: float, is_small: bool, seed: int, calibrated: int = CALIBRATED, seen: int = SEEN) -> Afternoon:
    """One arm, made from a seed."""
    arm = with_own_base(replace(load_arm(name), camera=Camera(position_noise_m=NOISE_m)))
    points = _recorded(arm, _hidden(arm, play_deg, is_small, seed), calibrated + seen)
    fitted, others = points.chosen(range(calibrated)), points.chosen(range(calibrated, calibrated + seen))
    zeros, plain = (calibrate(replace(arm, tolerances=None), fitted, fixed=fixed).arm for fixed in (_lengths(arm), ()))
    whole = calibrate(arm, fitted).arm
    gap = find_gap(whole, fitted)
    with tempfile.TemporaryDirectory() as folder:
        named = gap.save(Path(folder) / "gap")
    models = (arm, zeros, plain, whole, named, _of_urdf(named))
    errors = [np.linalg.norm(verify(arm, model, others).after_m, axis=1) for model in models]
    return Afternoon(name, play_deg, np.array(errors), gap.named)


def afternoon_of(sort: tuple[str, float, bool], number: int) -> Afternoon:
    """`afternoon`, as a task of a study."""
    return afternoon(*sort, number)


def webcam_afternoon(
    name: str, play_deg: float, is_small: bool, seed: int, calibrated: int = CALIBRATED, seen: int = SEEN
) -> Afternoon:
    """The same with pictures; the exported URDF is left out, whose error is that of its model and the play."""
    arm = replace(load_arm(name), tool=Tool(known=False), camera=Camera(position_noise_m=NOISE_m))
    hidden, draw = _hidden(arm, play_deg, is_small, seed), np.random.default_rng(seed)
    pictured = _pictured(arm, hidden)
    as_published = replace(pictured, deviations={})
    stops = _stops(arm, hidden, calibrated + seen, lambda pose: _shows_board(as_published, pose))
    targets_m = [pictured.last_link(pose).then(pictured.last_T_target).position_m for pose in stops.true_rad.tolist()]
    with tempfile.TemporaryDirectory() as folder:
        measured = _photographed(pictured, stops.points(np.full((len(stops.q_rad), 3), np.nan)), stops, Path(folder), draw)
        fitted = measured.chosen([k for k in range(len(measured)) if int(measured.point[k]) <= calibrated])
        zeros, plain = (calibrate(replace(arm, tolerances=None), fitted, fixed=fixed).arm for fixed in (_lengths(arm), ()))
        whole = calibrate(arm, fitted)
        in_base = points_in_base(whole.calibrated)
        if in_base is None:
            raise ArmError("the pictures gave no points in the base frame")
        gap = find_gap(whole.arm, in_base)
        named = gap.save(Path(folder) / "gap")
    others = stops.points(np.array(targets_m)).chosen(range(calibrated, calibrated + seen))
    x_m, y_m, z_m = BOARD_OFF_m
    published = replace(arm, tool=Tool((x_m, y_m, z_m)))
    errors = []
    for model in (published, zeros, plain, whole.arm, named):
        predicted_m = others.tip_m - verify(published, model, others).after_m
        errors.append(norms(others.tip_m - best_motion(predicted_m, others.tip_m).of(predicted_m)))
    return Afternoon(name, play_deg, np.array(errors), gap.named)


def webcam_afternoon_of(sort: tuple[str, float, bool], number: int) -> Afternoon:
    """`webcam_afternoon`, as a task of a study."""
    return webcam_afternoon(*sort, number)


@dataclass(frozen=True)
class _Stops:
    """What the runtime says at rest in m poses, and the truth: angles (m, n) [rad], tips in the base frame (m, 3) [m]."""

    q_rad: Array
    current_A: Array
    direction: Array
    true_rad: Array
    tip_m: Array

    def points(self, tip_m: Array) -> Points:
        return make_points(self.q_rad, tip_m, direction=self.direction, current_A=self.current_A, payload_kg=np.zeros(len(tip_m)))


def _lengths(arm: Arm) -> list[str]:
    """All of the geometry but the zeros."""
    return [f"{key}{i}" for i in range(1, len(arm.links) + 1) for key in ("d", "L", "alpha")]


def _hidden(arm: Arm, play_deg: float, is_small: bool, seed: int) -> Scenario:
    home_made = load_scenario("so101")
    has_friction = any(effect.effect == "coulomb_friction" for effect in arm.effects)
    every = EveryJoint(0.0 if has_friction else FRICTION, 0.0, math.radians(play_deg))
    true_dh = SMALL if is_small else home_made.true_dh
    return msgspec.structs.replace(home_made, seed=seed, every_joint=every, true_dh=true_dh)


def _recorded(arm: Arm, hidden: Scenario, count: int) -> Points:
    """Static poses all over the range; the tip in the base frame, as a camera of NOISE_m sees it."""
    stops = _stops(arm, hidden, count)
    return stops.points(stops.tip_m + np.random.default_rng(hidden.seed).normal(0.0, NOISE_m, (count, 3)))


def _stops(arm: Arm, hidden: Scenario, count: int, is_wanted: Callable[[Sequence[float]], bool] = lambda _: True) -> _Stops:
    """Wanted poses all over the range, moved to one after the other."""
    found: list[tuple[Array, Array, Array, Array, Array]] = []
    with tempfile.TemporaryDirectory() as folder:
        scenario = Path(folder) / "hidden.toml"
        scenario.write_bytes(scenario_bytes(hidden))
        with mock_arm(arm, scenario) as running:
            running.enable()
            for pose in filter(is_wanted, spread_poses(joint_box(arm, margin_rad=0.2), 20 * count)):
                try:
                    running.move_joints(pose)
                except RequestRefused:  # it, or the way there, is below the floor
                    continue
                running.wait(SETTLE_s)
                average = running.measure(AVERAGE_s)
                told = (np.array(average.q_rad), np.array(average.current_A), np.array(average.direction))
                found.append((*told, running.true_joint_rad(), running.true_tip_m()))
                if len(found) == count:
                    break
    return _Stops(*map(np.array, zip(*found, strict=True)))


def _pictured(arm: Arm, hidden: Scenario) -> PicturedArm:
    grey = BOARD.drawn(DOTS_A_METRE, MARGIN_m)
    mount = FramePose(rotation_of(np.array(MOUNT_rad)), np.array(BOARD_OFF_m))
    return PicturedArm(
        arm.links,
        arm.dh_convention,
        grey,
        grey.shape[1] / DOTS_A_METRE,
        mount,
        looking_at(np.array(CAMERA_m), np.array(VIEW_m)),
        Webcam(),
        hidden.drawn_deviations(len(arm.links)),
    )


def _shows_board(pictured: PicturedArm, pose: Sequence[float]) -> bool:
    """Whether the camera sees the whole board, near enough, and not from too far aside."""
    place = pictured.target(list(pose))
    away_m = float(np.linalg.norm(place.position_m))
    is_facing = place.rotation[:, 2] @ place.position_m > FACING * away_m
    return bool(is_facing and away_m < FARTHEST_m and is_inside(pictured.webcam, BOARD, place))


def _photographed(pictured: PicturedArm, points: Points, stops: _Stops, folder: Path, draw: np.random.Generator) -> Points:
    """What the pictures of all poses measure, by a lens that other pictures calibrate."""
    photograph_board(BOARD, pictured.webcam, folder / "lens", draw)
    (folder / "arm").mkdir()
    for key, pose in zip(zip(points.setup, points.point, points.repeat, strict=True), stops.true_rad.tolist(), strict=True):
        (folder / "arm" / f"{picture_name(*key)}.png").write_bytes(png_of(pictured.picture(pose, draw)))
    fit = fit_lens(BOARD, look_for(BOARD, picture_files(folder / "lens"), LENS_CORNERS))
    seen = look_for(BOARD, picture_files(folder / "arm"), CORNERS_LEAST)
    return with_pictures(points, measure_poses(BOARD, [CameraPictures("webcam", fit.lens, seen)]).measured)[0]


def _of_urdf(arm: Arm) -> Arm:
    """What another program loads: the links of the exported URDF alone."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "exported.urdf"
        file.write_text(exported(arm, "urdf")[0], encoding="utf-8")
        serial = read_arm(file, "urdf", None, None)
    links, _ = arm_links(serial, "standard")
    return replace(arm, links=links, effects=(), maps=(), tool=type(arm.tool)())


def main() -> None:
    """Print a table of every arm and play: mean and largest error over all seeds, and how often each effect was named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=1, help="arms of each sort")
    parser.add_argument("--arms", nargs="+", choices=tuple(PLAYS), default=tuple(PLAYS))
    parser.add_argument("--small", action="store_true", help="arms whose errors are small")
    parser.add_argument("--webcam", action="store_true", help="with rendered pictures, of an SO-101")
    add_options(parser)
    args = parser.parse_args()
    sorts = [(name, play_deg, args.small) for name in args.arms for play_deg in PLAYS[name]]
    task = afternoon_of
    if args.webcam:
        sorts, task = [sort for sort in sorts if sort[0] == "so101"], webcam_afternoon_of
    with executor(len(sorts) * args.cases, args.workers, args.cluster) as runs:
        for sort in sorts:
            found = [made for _, made in runs.results(task, sort, range(args.cases))]
            sys.stdout.writelines(f"{line}\n" for line in lines(found))
            sys.stdout.flush()


def lines(found: list[Afternoon]) -> Iterator[str]:
    """The table of arms of one sort."""
    name, play = found[0].arm, found[0].play_deg
    yield f"{name}, play of {play:g} deg ({PLAYS[name][play]}), {len(found)} arms"
    errors_mm = 1e3 * np.concatenate([one.error_m for one in found], axis=1)
    for model, error_mm in zip(MODELS, errors_mm, strict=False):  # by webcam without the last
        yield f"  {model:<22}{error_mm.mean():6.2f} mm mean{error_mm.max():7.2f} mm largest"
    yield f"  named: {'; '.join(', '.join(one.named) or 'nothing' for one in found)}"


if __name__ == "__main__":
    main()
