"""Pictures and sightings of printed targets, of known truth."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from calib.arrays import frozen
from calib.vision.lens import HERE, Lens, Pose
from calib.vision.targets import Charuco, PrintedTarget, SeenCorners, Sighting, Sightings, Tags
from hil_mocks.arm_pictures import PrintedSheet, Webcam

BOARD = Charuco(5, 7, 0.03, 0.0225)
TAG = Tags.single(7, 0.06)
WEBCAM = Webcam(640, 480, (560.0, 562.0), (325.0, 236.0))
NOISE_px = 0.05
MARGIN_m = 0.01
DOTS_A_METRE = 5000.0


def lens_of(webcam: Webcam = WEBCAM) -> Lens:
    """The lens that a mock webcam has."""
    values = [*webcam.focal_px, *webcam.centre_px, *webcam.radial, *webcam.tangential, 0.0]
    return Lens(frozen(values), webcam.width_px, webcam.height_px)


def corners_of(target: PrintedTarget) -> np.ndarray:
    """All corners (k, 3) of a target."""
    if isinstance(target, Tags):
        return np.concatenate(list(target.corners_m.values()))
    assert isinstance(target, Charuco)
    x = (np.arange(1, target.columns) - target.columns / 2) * target.square_m
    y = (np.arange(1, target.rows) - target.rows / 2) * target.square_m
    return np.array([[a, b, 0.0] for b in y for a in x])


def drawn_pose(rng: np.random.Generator, tilt: float = 0.6, near: float = 0.3, far: float = 0.55) -> Pose:
    """A pose before the camera, tilted up to `tilt` about each axis of the picture."""
    turn = Rotation.from_rotvec([*rng.uniform(-tilt, tilt, 2), 0.0]) * Rotation.from_rotvec([0, 0, rng.uniform(-1, 1)])
    away = rng.uniform(near, far)
    return Pose(turn.as_matrix(), np.array([away * rng.uniform(-0.3, 0.3), away * rng.uniform(-0.2, 0.2), away]))


def sighting(
    name: str,
    target: PrintedTarget,
    pose: Pose,
    rng: np.random.Generator,
    stand: Pose = HERE,
    noise_px: float = NOISE_px,
    lens: Lens | None = None,
) -> Sighting:
    """What a camera finds, with noise, of the corners inside its picture."""
    lens, corners = lens or lens_of(), corners_of(target)
    pixels = lens.project(stand.after(pose).of(corners))
    inside = ((pixels > 4.0) & (pixels < [lens.width_px - 4, lens.height_px - 4])).all(axis=1)
    seen = pixels[inside] + rng.normal(0.0, noise_px, (inside.sum(), 2))
    return Sighting(name, SeenCorners(frozen(corners[inside]), frozen(seen)), 0.8, 200.0)


def sightings(
    target: PrintedTarget, poses: list[Pose], rng: np.random.Generator, stand: Pose = HERE, lens: Lens | None = None
) -> Sightings:
    """One picture a pose, called p00, p01, ..."""
    seen = [sighting(f"p{k:02d}", target, pose, rng, stand, lens=lens) for k, pose in enumerate(poses)]
    return Sightings(WEBCAM.width_px, WEBCAM.height_px, tuple(seen), ())


def picture(target: Charuco | Tags, pose: Pose, rng: np.random.Generator, webcam: Webcam = WEBCAM) -> np.ndarray:
    """A rendered picture of a print."""
    grey = target.drawn(DOTS_A_METRE, MARGIN_m)
    return webcam.picture([PrintedSheet(grey, grey.shape[1] / DOTS_A_METRE, pose.rotation, pose.position_m)], rng)
