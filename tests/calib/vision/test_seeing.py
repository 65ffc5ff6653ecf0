"""Corners in rendered pictures, and the lens: exact derivatives, no bias, prints that are refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.errors import VisionError
from calib.vision.intrinsics import fit_lens
from calib.vision.lens import NAMES, Lens
from calib.vision.targets import Charuco, Tags, look_for, png_of, read_picture, read_tags, sharpness
from tests.calib.vision.scenes import BOARD, TAG, WEBCAM, corners_of, drawn_pose, lens_of, picture

LEGACY = Charuco(8, 6, 0.02, 0.015)  # an even number of rows, with which both layouts differ
SIDEWAYS = dataclasses.replace(LEGACY, columns=6, rows=8)
LENS = Lens(np.array([900.0, 905.0, 641.0, 355.0, -0.25, 0.1, 1e-3, -2e-3, 0.03]), 1280, 720)


def test_the_lens_projects_as_opencv_does_and_its_derivatives_are_exact() -> None:
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 3)) + np.array([0.0, 0.0, 1.0])
    pixels, by_point, by_values = LENS.slopes(points)
    wanted, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), LENS.matrix, np.array(LENS.distortion))
    assert np.abs(pixels - wanted[:, 0]).max() < 1e-9
    h = 1e-6
    for axis, step in enumerate(h * np.eye(3)):
        slope = (LENS.project(points + step) - LENS.project(points - step)) / (2 * h)
        assert np.abs(slope - by_point[:, :, axis]).max() < 1e-5
    for k in range(len(NAMES)):
        step = h * max(1.0, abs(LENS.values[k])) * np.eye(len(NAMES))[k]
        more, less = (dataclasses.replace(LENS, values=LENS.values + sign * step) for sign in (1, -1))
        slope = (more.project(points) - less.project(points)) / (2 * step[k])
        assert np.abs(slope - by_values[:, :, k]).max() < 1e-5


@pytest.mark.parametrize(("target", "limit_px"), [(BOARD, 0.06), (TAG, 0.1)])
def test_corners_of_rendered_pictures_are_found_to_a_fraction_of_a_pixel_without_bias(
    target: Charuco | Tags, limit_px: float
) -> None:
    rng, errors = np.random.default_rng(1), []
    for _ in range(3):
        pose = drawn_pose(rng)
        corners = target.find(picture(target, pose, rng).astype(np.uint8))
        assert len(corners) >= 0.8 * target.count
        error = corners.picture_px - lens_of().project(pose.of(corners.target_m))
        keep = np.linalg.norm(error, axis=1) < 0.5  # one corner in fifty lies beside its place: the fit drops it
        assert keep.mean() > 0.9
        outward = corners.picture_px - corners.picture_px.mean(axis=0)
        outward /= np.linalg.norm(outward, axis=1)[:, None]
        errors.append((error[keep], np.sum(error * outward, axis=1)[keep]))
    whole = np.concatenate([error for error, _ in errors])
    assert np.sqrt(np.mean(whole**2)) < limit_px
    assert abs(np.mean(np.concatenate([out for _, out in errors]))) < 0.06  # a target that looks too large looks too near


@pytest.mark.parametrize("seed", [3, 29, 56])
def test_a_tag_in_full_view_is_found_from_near_too(seed: int) -> None:
    """Pictures from 0.12 to 0.2 m in which OpenCV's search by contours misses it."""
    rng = np.random.default_rng(seed)
    pose = drawn_pose(rng, tilt=0.3, near=0.12, far=0.2)
    corners = TAG.find(picture(TAG, pose, rng))
    assert len(corners) == 4
    assert np.abs(corners.picture_px - lens_of().project(pose.of(corners.target_m))).max() < 3.0


def test_sharpness_tells_blur_and_contrast() -> None:
    rng = np.random.default_rng(2)
    pose = drawn_pose(rng, tilt=0.1, near=0.3, far=0.31)
    found = []
    for blur in (0.7, 3.0):
        seen = picture(BOARD, pose, rng, dataclasses.replace(WEBCAM, blur_px=blur)).astype(np.uint8)
        found.append(sharpness(seen, lens_of().project(pose.of(corners_of(BOARD)))))
    (sharp, contrast), (soft, _) = found
    assert 0.6 < sharp < 1.3
    assert 2.0 < soft < 4.0
    assert contrast > 150.0


@pytest.mark.parametrize(
    ("made", "says"),
    [
        (lambda: Charuco(2, 7, 0.03, 0.02), "expected 3 to 50 squares a side"),
        (lambda: Charuco(5, 7, 0.03, 0.03), "--marker: expected a length between 0 and the square's 30 mm"),
        (lambda: Charuco(5, 7, 0.03, 0.02, "4x4"), "--dictionary: expected one of 4x4_100"),
        (lambda: Charuco(20, 20, 0.03, 0.02, "4x4_50"), "needs 200 markers"),
        (lambda: Tags.single(587, 0.05), "has tags 0 to 586, got 587"),
        (lambda: Tags.single(1, -0.05), "--size: expected"),
    ],
)
def test_targets_that_cannot_be_printed_are_refused(made, says: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(VisionError, match=says.replace("(", r"\(")):
        made()


def test_tags_of_a_body_are_read_with_their_turns(tmp_path: Path) -> None:
    file = tmp_path / "tags.csv"
    file.write_text("tag,size_m,x_m,y_m,z_m,qw,qx,qy,qz\n3,0.04,0.1,0,0,,,,\n4,0.04,0,0,0.1,0.70710678,0,0.70710678,0\n")
    tags = read_tags(file)
    assert tags.corners_m[3][0] == pytest.approx([0.08, -0.02, 0.0])
    assert tags.corners_m[4][0] == pytest.approx([0.0, -0.02, 0.12])
    assert not tags.is_flat
    file.write_text("tag,size_m,x_m,y_m,z_m\n3,0.04,0,0,0\n3,0.04,0,0,0\n")
    with pytest.raises(VisionError, match="line 3: tag 3 appears twice"):
        read_tags(file)
    file.write_text("tag,size_m,x_m,y_m,z_m\n3,0.04,0,0,near\n")
    with pytest.raises(VisionError, match='line 2, column z_m: got "near", expected a finite number'):
        read_tags(file)


def test_unusable_pictures_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"not a picture")
    with pytest.raises(VisionError, match=r"a\.png: not a picture"):
        read_picture(tmp_path / "a.png")
    for name, shape in (("a.png", (48, 64)), ("b.png", (64, 48))):
        (tmp_path / name).write_bytes(png_of(np.full(shape, 128, np.uint8)))
    files = [tmp_path / "a.png", tmp_path / "b.png"]
    with pytest.raises(VisionError, match=r"48 x 64 pixels, a\.png has 64 x 48"):
        look_for(BOARD, files, 4)
    assert look_for(BOARD, files[:1], 4).unseen == ("a",)


@pytest.mark.parametrize(
    ("printed", "option"), [(dataclasses.replace(LEGACY, is_legacy=True), "with --legacy"), (SIDEWAYS, "with --board 6x8")]
)
def test_pictures_that_only_another_option_makes_readable_name_it(tmp_path: Path, printed: Charuco, option: str) -> None:
    rng, files = np.random.default_rng(4), []
    for k in range(2):
        file = tmp_path / f"{k}.png"
        file.write_bytes(png_of(picture(printed, drawn_pose(rng, tilt=0.3), rng)))
        files.append(file)
    sightings = look_for(LEGACY, files, 6)
    assert (sightings.seen, sightings.remedy) == ((), f"{option}, 2 of 2 pictures show it")
    with pytest.raises(VisionError, match=f"4 are needed: {option}"):
        fit_lens(LEGACY, sightings)
    assert len(look_for(printed, files, 6).seen) == 2
