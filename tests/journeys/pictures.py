"""Takes the pictures of a webcam beside the mock: of a board held before it, and of that board on the arm's last link."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from calib.arm_problem.observations import rotation_of
from calib.points.points import make_points
from calib.points.writer import write_points
from calib.vision.poses import picture_name
from calib.vision.targets import Charuco, png_of
from control.model.description import load_arm
from hil_mocks.arm_pictures import FramePose, PicturedArm, PrintedSheet, Webcam, looking_at
from hil_mocks.scenario import load_scenario

BOARD = Charuco(5, 7, 0.03, 0.0225)
DOTS_A_METRE, MARGIN_m = 6000.0, 0.01
LENS, POSES, OTHERS = 16, 40, 12  # the last to verify at
NEAREST_m, FARTHEST_m = 0.35, 1.3
FACING = 0.6  # cosine between the line of sight and the board's normal
ACROSS, UPWARD = (0.45, 0.3)  # of the distance: how far from the middle of the picture the whole board is still in it


def main(built: str, pictures: str, scenario: str) -> None:
    """Folders `lens`, `arm` and `others` of pictures; angles.csv and others.csv: what the encoders said at the last two."""
    arm, draw, webcam, out = load_arm(built), np.random.default_rng(6), Webcam(), Path(pictures)
    grey = BOARD.drawn(DOTS_A_METRE, MARGIN_m)
    width_m = grey.shape[1] / DOTS_A_METRE
    for name in ("lens", "arm", "others"):
        (out / name).mkdir(parents=True)
    for k in range(LENS):
        away_m = draw.uniform(0.28, 0.6)
        turn = rotation_of(np.array([*draw.uniform(-0.6, 0.6, 2), 0.0])) @ rotation_of(
            np.array([0.0, 0.0, draw.uniform(-1.5, 1.5)])
        )
        place_m = np.array([(k % 3 - 1) * 0.28, (k // 3 % 3 - 1) * 0.2, 1.0]) * away_m
        (out / "lens" / f"board_{k:02d}.png").write_bytes(
            png_of(webcam.picture([PrintedSheet(grey, width_m, turn, place_m)], draw))
        )
    lower, upper = np.array(arm.limits_rad).T
    rest = np.array(arm.rest.q_rad if arm.rest else np.zeros(arm.joint_count))
    deviations = load_scenario(scenario).drawn_deviations(len(arm.links))
    unseen = FramePose(np.eye(3), np.zeros(3))
    bare = PicturedArm(arm.links, arm.dh_convention, grey, width_m, unseen, unseen, webcam, deviations).last_link(rest.tolist())
    camera = looking_at(bare.position_m + np.array([0.75, 0.2, 0.1]), bare.position_m)
    # At rest the board looks at the camera, a little askew.
    mount = FramePose(
        bare.rotation.T @ camera.rotation @ rotation_of(np.array([0.25, -0.2, 0.1])), np.array([0.012, -0.009, 0.02])
    )
    pictured = PicturedArm(arm.links, arm.dh_convention, grey, width_m, mount, camera, webcam, deviations)
    poses: list[list[float]] = []
    while len(poses) < POSES + OTHERS:
        q_rad = np.clip(rest + draw.normal(0.0, 0.45, arm.joint_count), lower, upper).tolist()
        place = pictured.target(q_rad)
        away_m = float(np.linalg.norm(place.position_m))
        x, y = np.abs(place.position_m[:2]) / away_m
        is_facing = place.rotation[:, 2] @ place.position_m > FACING * away_m
        if is_facing and NEAREST_m < away_m < FARTHEST_m and x < ACROSS and y < UPWARD:
            poses.append(q_rad)
    for folder, angles, taken in (("arm", "angles.csv", poses[:POSES]), ("others", "others.csv", poses[POSES:])):
        count = len(taken)
        names = [f"{folder}{k:02d}" for k in range(count)]
        for name, q in zip(names, taken, strict=True):
            file = out / folder / f"{picture_name('free', name, 1)}.png"
            file.write_bytes(png_of(pictured.picture(q, draw)))
        unseen_m = np.full((count, 3), np.nan)
        points = make_points(["free"] * count, names, [1] * count, np.array(taken), unseen_m)
        write_points(out / angles, points)


if __name__ == "__main__":
    main(*sys.argv[1:])
