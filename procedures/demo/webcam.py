"""`armwright demo camera`: a webcam beside a mock arm, from pictures of a board to a calibrated arm.

Pictures are rendered with the mock's hidden geometry; everything else works on the files alone, as the commands do. The result is
compared with the truth at poses all over the workspace, of which there is no picture.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.observations import rotation_of
from calib.arrays import Array, norms
from calib.boards import best_motion
from calib.calibration import Calibrated, CalibrationPlan, calibrate, write_calibrated_arm
from calib.identify.identification import identify
from calib.points.points import FREE, Points, make_points
from calib.points.writer import write_points
from calib.results import input_file, made_today
from calib.vision.advice import advice
from calib.vision.intrinsics import CORNERS_LEAST as LENS_CORNERS
from calib.vision.intrinsics import LensFit, fit_lens, write_camera
from calib.vision.lens import Lens
from calib.vision.poses import CORNERS_LEAST, CameraPictures, PoseSet, measure_poses, picture_name, with_pictures
from calib.vision.targets import Charuco, look_for, picture_files, png_of
from control.files import write_whole
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Tool
from control.model.description import save_arm
from control.plain_text import Advance, silent
from hil_mocks.arm_pictures import FramePose, PicturedArm, PrintedSheet, Webcam, looking_at
from hil_mocks.scenario import load_scenario

BOARD = Charuco(5, 7, 0.03, 0.0225)
DOTS_A_METRE = 6000.0
MARGIN_m = 0.01
LENS_PICTURES = 20
ARM_PICTURES = 45
WORKSPACE_POSES = 300
CAMERA_m = np.array([1.1, 0.3, 0.45])  # in front of the arm, at the height of its elbow
VIEW_m = np.array([0.35, 0.0, 0.4])
MOUNT_rad = np.array([2.42, 0.5, -0.74])  # how the board sits on the last link: towards the camera where the arm reaches forward
BOARD_OFF_m = np.array([0.012, -0.009, 0.02])  # where it really sits; the user's file says: at the tip
LEAST_HEIGHT_m = 0.1
NEAREST_m, FARTHEST_m = 0.35, 1.1
FACING = 0.5  # cosine between the line of sight and the board's normal
RIM_px = 30.0


@dataclass(frozen=True, slots=True)
class WebcamOutcome:
    """Files in the folder, and errors [m] of the target over the workspace (k,), both arms placed where they fit best."""

    lens: LensFit
    true_focal_px: float
    poses: PoseSet
    made: Calibrated
    rank_by_position: int
    before_m: Array
    after_m: Array


def run(arm: Arm, scenario_file: Path, out: Path, advance: Advance) -> WebcamOutcome:
    """Take the pictures, then do what `camera calibrate`, `camera poses` and `calibrate` do."""
    scenario = load_scenario(scenario_file)
    draw, webcam = np.random.default_rng(scenario.seed), Webcam()
    nominal = dataclasses.replace(arm, tool=Tool(known=False), name=arm.name)
    save_arm(nominal, out / "nominal.toml")
    pictured = _pictured(arm, scenario.drawn_deviations(len(arm.links)), webcam)
    q = _seen_poses(pictured, arm, draw)
    photograph_board(BOARD, webcam, out / "lens", draw, advance)
    points = _photograph_arm(pictured, q, out, draw, advance)

    advance("calibrating the lens", 0.75)
    files = picture_files(out / "lens")
    fit = fit_lens(BOARD, look_for(BOARD, files, LENS_CORNERS))
    write_camera(out / "camera.json", fit, BOARD.name, advice(fit), made_today())
    advance("measuring poses", 0.8)
    seen = look_for(BOARD, picture_files(out / "arm"), CORNERS_LEAST)
    poses = measure_poses(BOARD, [CameraPictures("webcam", fit.lens, seen)])
    measured, _ = with_pictures(points, poses.measured)
    write_points(out / "points.csv", measured)
    advance("calibrating the arm", 0.9)
    made = calibrate(nominal, measured, CalibrationPlan())
    by_position = dataclasses.replace(measured, orientation=np.full((len(measured), 4), np.nan))
    rank = identify(problem_of(nominal, by_position, Choice(freed=("camera",))), starts_count=1).rank
    of_points = made_today(input_file(out / "points.csv", "points"))
    write_calibrated_arm(out / "arm_calibrated.toml", nominal, made.found, of_points)
    before, after = _over_workspace(pictured, nominal, made.arm, draw)
    return WebcamOutcome(fit, webcam.focal_px[0], poses, made, rank, before, after)


def findings(outcome: WebcamOutcome) -> tuple[str, ...]:
    """What was found, against the truth."""
    identification, lens = outcome.made.found, outcome.lens.lens
    return (
        f"Lens: {len(outcome.lens.seen)} pictures, residual {outcome.lens.rms_px:.3f} px; focal length"
        f" {lens.values[0]:.2f} px (sd {lens.sd[0]:.2f}), true {outcome.true_focal_px:.2f} px.",
        f"Poses: {len(outcome.poses.measured)} of {ARM_PICTURES} pictures; the points scatter"
        f" {identification.weighted or 0.0:.2f} times as much as their covariances say.",
        f"Determined: {identification.rank} of {len(identification.estimates)} parameters with orientations,"
        f" {outcome.rank_by_position} of {len(identification.estimates) - 3} by positions alone.",
        f"Error of the target at {WORKSPACE_POSES} poses all over the workspace, against the truth:"
        f" {_words(outcome.before_m)} before, {_words(outcome.after_m)} after.",
    )


def _words(error_m: Array) -> str:
    return f"mean {1e3 * float(error_m.mean()):.2f} mm (largest {1e3 * float(error_m.max()):.2f})"


def _pictured(arm: Arm, deviations: dict[str, float], webcam: Webcam) -> PicturedArm:
    grey = BOARD.drawn(DOTS_A_METRE, MARGIN_m)
    width_m = grey.shape[1] / DOTS_A_METRE
    camera = looking_at(CAMERA_m, VIEW_m)
    mount = FramePose(rotation_of(MOUNT_rad), BOARD_OFF_m)
    return PicturedArm(arm.links, arm.dh_convention, grey, width_m, mount, camera, webcam, deviations)


def _seen_poses(pictured: PicturedArm, arm: Arm, draw: np.random.Generator) -> Array:
    """Poses (ARM_PICTURES, n) in which the camera sees the whole board."""
    poses_rad: list[Array] = []
    while len(poses_rad) < ARM_PICTURES:
        q = _drawn(arm, draw)
        place = pictured.target(q.tolist())
        away = float(np.linalg.norm(place.position_m))
        is_above = pictured.last_link(q.tolist()).position_m[2] > LEAST_HEIGHT_m
        is_facing = place.rotation[:, 2] @ place.position_m > FACING * away
        if is_above and is_facing and NEAREST_m < away < FARTHEST_m and is_inside(pictured.webcam, BOARD, place):
            poses_rad.append(q)
    return np.array(poses_rad)


def is_inside(webcam: Webcam, board: Charuco, place: FramePose) -> bool:
    """Whether the picture shows the whole board, which is at `place` in the camera's frame."""
    width, height = board.print_m
    corners = np.array([[x, y, 0.0] for x in (-width / 2, width / 2) for y in (-height / 2, height / 2)])
    points = corners @ place.rotation.T + place.position_m
    values = [*webcam.focal_px, *webcam.centre_px, *webcam.radial, *webcam.tangential, 0.0]
    pixels = Lens(np.array(values), webcam.width_px, webcam.height_px).project(points)
    inner = (pixels > RIM_px) & (pixels < np.array([webcam.width_px, webcam.height_px]) - RIM_px)
    return bool(points[:, 2].min() > 0.1 and inner.all())


def _drawn(arm: Arm, draw: np.random.Generator) -> Array:
    lower = np.array([drive.joint_lower_rad for drive in arm.drives])
    upper = np.array([drive.joint_upper_rad for drive in arm.drives])
    return np.asarray(draw.uniform(lower, upper))


def photograph_board(board: Charuco, webcam: Webcam, folder: Path, draw: np.random.Generator, advance: Advance = silent) -> None:
    """The board held before the camera: tilted to all sides, near and far, in all parts of the picture."""
    folder.mkdir(parents=True)
    grey = board.drawn(DOTS_A_METRE, MARGIN_m)
    for k in range(LENS_PICTURES):
        advance("pictures of the board", 0.25 * k / LENS_PICTURES)
        away = draw.uniform(0.28, 0.6) * board.print_m[0] / BOARD.print_m[0]
        column, row = (k % 3 - 1) * 0.28, (k // 3 % 3 - 1) * 0.2
        turn = rotation_of(np.array([*draw.uniform(-0.6, 0.6, 2), 0.0])) @ rotation_of(np.array([0, 0, draw.uniform(-1.5, 1.5)]))
        place = np.array([column * away, row * away, away])
        sheet = PrintedSheet(grey, grey.shape[1] / DOTS_A_METRE, turn, place)
        write_whole(folder / f"board_{k:02d}.png", png_of(webcam.picture([sheet], draw)))


def _photograph_arm(pictured: PicturedArm, q: Array, out: Path, draw: np.random.Generator, advance: Advance) -> Points:
    """One picture a pose, called as its point; joint_angles.csv has what the encoders said."""
    (out / "arm").mkdir(parents=True)
    names = [f"p{k:02d}" for k in range(len(q))]
    for k, (name, pose) in enumerate(zip(names, q.tolist(), strict=True)):
        advance("pictures of the arm", 0.25 + 0.5 * k / len(q))
        file = out / "arm" / f"{picture_name('free', name, 1)}.png"
        write_whole(file, png_of(pictured.picture(pose, draw)))
    points = make_points([FREE] * len(q), names, [1] * len(q), q, np.full((len(q), 3), np.nan))
    write_points(out / "joint_angles.csv", points)
    return points


def _over_workspace(pictured: PicturedArm, nominal: Arm, calibrated: Arm, draw: np.random.Generator) -> tuple[Array, Array]:
    """Errors (k,) of the target's place, before and after. Each arm is put where its targets fit the true ones best.

    Before: the nominal arm with the true place of the target on the last link.
    """
    q = np.array([_drawn(nominal, draw) for _ in range(WORKSPACE_POSES)])
    true = np.array([pictured.last_link(pose).then(pictured.last_T_target).position_m for pose in q.tolist()])
    x, y, z = BOARD_OFF_m.tolist()
    mounted = dataclasses.replace(nominal, tool=Tool(position_m=(x, y, z)))
    return _fitted(ForwardKinematics(mounted).tips(q), true), _fitted(ForwardKinematics(calibrated).tips(q), true)


def _fitted(predicted: Array, true: Array) -> Array:
    return norms(true - best_motion(predicted, true).of(predicted))
