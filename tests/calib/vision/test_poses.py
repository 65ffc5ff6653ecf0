"""Poses of a target: covariances that hold, several cameras, pictures that give no pose."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.errors import VisionError
from calib.points.points import make_points
from calib.vision.advice import poses_text
from calib.vision.intrinsics import fit_lens
from calib.vision.lens import CameraView, Pose, misfit
from calib.vision.poses import CameraPictures, MeasuredPose, PoseSet, measure_poses, motion_covariance, with_pictures
from calib.vision.targets import PrintedTarget, Tags
from tests.calib.vision.scenes import BOARD, TAG, drawn_pose, lens_of, sighting, sightings

STAND = Pose(Rotation.from_rotvec([0.1, 0.6, -0.05]).as_matrix(), np.array([-0.25, 0.02, 0.1]))


def error_of(one: MeasuredPose, true: Pose) -> np.ndarray:
    turn = Rotation.from_matrix(one.pose.rotation @ true.rotation.T).as_rotvec()
    return np.array([*(one.pose.position_m - true.position_m), *turn])


def seen_by(target: PrintedTarget, seed: int, cameras: int, count: int = 14) -> tuple[list[CameraPictures], list[Pose]]:
    """Cameras whose pictures all show the whole target, and the true poses."""
    rng, poses = np.random.default_rng(seed), []
    while len(poses) < count:
        pose = drawn_pose(rng, near=0.4, far=0.6)
        whole = [sighting("", target, pose, rng, stand) for stand in (Pose(np.eye(3), np.zeros(3)), STAND)]
        if all(len(one.corners) == target.count for one in whole):
            poses.append(pose)
    first = CameraPictures("first", lens_of(), sightings(target, poses, rng))
    return [first, CameraPictures("second", lens_of(), sightings(target, poses, rng, STAND))][:cameras], poses


@pytest.mark.parametrize(("target", "cameras"), [(BOARD, 1), (BOARD, 2), (TAG, 1)])
def test_the_covariance_is_that_of_the_errors(target: PrintedTarget, cameras: int) -> None:
    squares = []
    for seed in range(1):
        seen, poses = seen_by(target, seed, cameras)
        found = measure_poses(target, seen)
        assert not found.rejected
        for one in found.measured:
            error = error_of(one, poses[int(one.name[1:])])
            squares.append(error @ np.linalg.solve(one.covariance, error) / 6.0)
    assert 0.6 < np.mean(squares) < 1.5


def test_the_lens_leaves_an_error_that_all_pictures_share() -> None:
    rng, squares = np.random.default_rng(1), []
    for _ in range(2):
        lens = fit_lens(BOARD, sightings(BOARD, [drawn_pose(rng) for _ in range(8)], rng)).lens
        poses = [drawn_pose(rng, tilt=0.4, near=0.45, far=0.5) for _ in range(6)]
        found = measure_poses(BOARD, [CameraPictures("one", lens, sightings(BOARD, poses, rng))])
        error = np.array([error_of(one, poses[int(one.name[1:])]) for one in found.measured])
        common = found.measured[0].common
        squares += [np.mean(error, axis=0)[k] ** 2 / common[k, k] for k in range(3)]
        own = found.measured[0].covariance - common
        assert np.trace(own[:3, :3]) < 0.5 * np.trace(common[:3, :3])  # so more pictures do not help
    assert 0.05 < np.mean(squares) < 4.0


def test_two_cameras_know_where_they_stand_and_see_better_than_one() -> None:
    both, poses = seen_by(BOARD, 3, 2)
    found, alone = measure_poses(BOARD, both), measure_poses(BOARD, both[:1])
    stand = found.stands["second"]
    off = np.array([*(stand.pose.position_m - STAND.position_m), 0, 0, 0])
    assert np.abs(off[:3]).max() < 5.0 * np.sqrt(np.diag(stand.covariance)[:3]).max()
    worst = [max(np.linalg.eigvalsh(one.covariance[:3, :3])[-1] for one in some.measured) for some in (found, alone)]
    assert worst[0] < 0.3 * worst[1]  # two lines of sight have no direction in common
    assert len(found.measured) == len(poses)


def test_derivatives_of_the_reprojection_are_exact() -> None:
    rng = np.random.default_rng(4)
    pose = drawn_pose(rng)
    view = CameraView(lens_of(), sighting("a", BOARD, pose, rng).corners, STAND)
    part, h = misfit(view, pose), 1e-7
    for k, step in enumerate(h * np.eye(6)):
        slope = (misfit(view, pose.moved(step)).error_px - misfit(view, pose.moved(-step)).error_px) / (2 * h)
        assert np.abs(slope + part.by_pose[:, k]).max() < 1e-3
        more, less = (dataclasses.replace(view, stand=STAND.moved(sign * step)) for sign in (1, -1))
        slope = (misfit(more, pose).error_px - misfit(less, pose).error_px) / (2 * h)
        assert np.abs(slope + part.by_stand[:, k]).max() < 1e-3


def test_a_small_tag_seen_head_on_is_rejected_as_ambiguous() -> None:
    rng, tag = np.random.default_rng(5), Tags.single(7, 0.02)
    head_on = [drawn_pose(rng, tilt=0.05, near=0.6, far=0.7) for _ in range(6)]
    tilted = [drawn_pose(rng, tilt=0.8, near=0.2, far=0.21) for _ in range(6)]
    poses = measure_poses(tag, [CameraPictures("one", lens_of(), sightings(tag, [*head_on, *tilted], rng))])
    assert sum("fits two poses" in one.reason for one in poses.rejected) >= 2
    assert all(int(one.name[1:]) < 6 for one in poses.rejected)


def test_a_picture_unlike_the_others_is_rejected() -> None:
    (camera,), _ = seen_by(BOARD, 6, 1, count=8)
    first, *others = camera.pictures.seen
    bent = first.corners.picture_px + 2.0 * np.sin(40.0 * first.corners.target_m[:, :2])
    bad = dataclasses.replace(first, corners=dataclasses.replace(first.corners, picture_px=bent))
    pictures = dataclasses.replace(camera.pictures, seen=(bad, *others))
    poses = measure_poses(BOARD, [dataclasses.replace(camera, pictures=pictures)])
    assert [one.name for one in poses.rejected] == ["p00"]
    assert "times the usual" in poses.rejected[0].reason


def test_a_rolling_shutter_costs_accuracy_only_while_the_target_moves() -> None:
    rng = np.random.default_rng(7)
    lens = dataclasses.replace(lens_of(), readout_s=0.03)
    views = [CameraView(lens, sighting("a", BOARD, drawn_pose(rng), rng).corners)]
    assert not motion_covariance(views, 0.0).any()
    spread = np.sqrt(np.diag(motion_covariance(views, 0.01)))
    assert spread[0] == pytest.approx(0.01 * 0.03 / np.sqrt(12.0))
    assert 0.0 < spread[3] < 0.01


def test_cameras_that_never_saw_the_target_together_are_refused() -> None:
    (first, second), _ = seen_by(BOARD, 8, 2, count=6)
    renamed = tuple(dataclasses.replace(one, name=f"other{one.name}") for one in second.pictures.seen)
    second = dataclasses.replace(second, pictures=dataclasses.replace(second.pictures, seen=renamed))
    with pytest.raises(VisionError, match="both saw the target in 0 pictures of one name, 3 are needed"):
        measure_poses(BOARD, [first, second])
    small = dataclasses.replace(first.lens, width_px=1280)
    with pytest.raises(VisionError, match="was calibrated with 1280 x 480 pixels, its pictures have 640 x 480"):
        measure_poses(BOARD, [dataclasses.replace(first, lens=small)])


def test_pictures_belong_to_the_poses_that_their_names_say() -> None:
    (camera,), _ = seen_by(BOARD, 9, 1, count=6)
    measured = measure_poses(BOARD, [camera]).measured
    names = [f"free_{one.name}_1" for one in measured]
    named = [dataclasses.replace(one, name=name) for one, name in zip(measured, names, strict=True)]
    q = np.zeros((5, 3))
    points = make_points(["free"] * 5, [f"p{k:02d}" for k in range(5)], [1] * 5, q, np.full((5, 3), np.nan))
    made, said = with_pictures(points, named[1:])
    assert made.point == ("p01", "p02", "p03", "p04")
    assert made.in_camera_frame
    assert np.array_equal(made.tip_m[0], measured[1].pose.position_m)
    assert "belong to no pose of the points: free_p05_1" in said[0]
    assert "1 poses of the points have no measured picture" in said[1]
    with pytest.raises(VisionError, match=r"expected names such as free_p00_1\.png"):
        with_pictures(points, measured)


def test_how_certain_poses_are_is_said_along_the_view_and_across_it() -> None:
    ray = np.array([0.6, 0.0, 0.8])
    along_m, across_m, turns_rad = 3e-3, 0.25e-3, np.array([1e-3, 2e-3, 5e-3])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = across_m**2 * np.eye(3) + (along_m**2 - across_m**2) * np.outer(ray, ray)
    covariance[3:, 3:] = np.diag(turns_rad**2)
    one = MeasuredPose("p1", Pose(np.eye(3), 0.5 * ray), covariance, 0.25 * covariance, 0.1, 20, ("left",))
    text = poses_text(PoseSet((one,), (), {}, {"left": 0.05}))
    assert "median: 0.250 mm across the view, 3.000 mm along it, 5.00 mrad" in text
    assert "common to all pictures (lens, stands): 0.125 mm across, 1.500 mm along, 2.50 mrad" in text
