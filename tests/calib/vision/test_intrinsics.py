"""The lens from pictures of a board: standard deviations that hold, and advice on what pictures lack."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from calib.errors import VisionError
from calib.results import made_today
from calib.vision.advice import advice
from calib.vision.intrinsics import LensFit, fit_lens, read_camera, write_camera
from calib.vision.lens import Pose
from calib.vision.targets import Sightings
from tests.calib.vision.scenes import BOARD, NOISE_px, drawn_pose, lens_of, sightings


def fitted(seed: int, count: int = 20, **how: float) -> LensFit:
    rng = np.random.default_rng(seed)
    return fit_lens(BOARD, sightings(BOARD, [drawn_pose(rng, **how) for _ in range(count)], rng))


def test_the_lens_is_found_within_its_standard_deviations() -> None:
    scores = []
    for seed in range(2):
        fit = fitted(seed, count=15)
        assert fit.lens.noise_px == pytest.approx(NOISE_px, rel=0.15)
        assert fit.lens.values[8] == 0.0  # no sixth-order distortion is there, none is identified
        scores.append((fit.lens.values - lens_of().values)[:8] / fit.lens.sd[:8])
    assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 1.5
    assert fit.held_out_px is not None
    assert fit.rms_px < fit.held_out_px < 1.6 * fit.rms_px


def test_a_sixth_order_distortion_is_identified_where_there_is_one() -> None:
    """The start has none, so it and all that leans on it must come from the refinement."""
    true = dataclasses.replace(lens_of(), values=lens_of().values + np.eye(9)[8] * 0.6)
    rng = np.random.default_rng(11)
    poses = [drawn_pose(rng) for _ in range(15)]
    fit = fit_lens(BOARD, sightings(BOARD, poses, rng, lens=true))
    assert fit.lens.values[8] > 10.0 * fit.lens.sd[8]
    assert np.sqrt(np.mean(((fit.lens.values - true.values) / fit.lens.sd) ** 2)) < 1.8
    assert fit.lens.noise_px == pytest.approx(NOISE_px, rel=0.15)


def test_a_corner_beside_its_place_is_left_out() -> None:
    rng = np.random.default_rng(3)
    pictures = sightings(BOARD, [drawn_pose(rng) for _ in range(15)], rng)
    first, *others = pictures.seen
    wrong = np.array(first.corners.picture_px)
    wrong[4] += [1.5, -1.0]
    moved = dataclasses.replace(first, corners=dataclasses.replace(first.corners, picture_px=wrong))
    fit = fit_lens(BOARD, dataclasses.replace(pictures, seen=(moved, *others)))
    assert first.corners.target_m[4].tolist() not in fit.seen[0].sighting.corners.target_m.tolist()
    assert len(fit.seen[0].sighting.corners) >= len(first.corners) - 4
    assert fit.lens.noise_px == pytest.approx(NOISE_px, rel=0.2)


def test_good_pictures_lack_nothing() -> None:
    assert advice(fitted(4, count=24)) == ()


def said(fit: LensFit) -> str:
    return "; ".join(advice(fit))


def test_advice_names_what_is_missing() -> None:
    assert "6 pictures show the board: take at least 15" in said(fitted(5, count=6))
    head_on = said(fitted(6, count=10, tilt=0.15))
    assert "tilted by more than 15 deg about the picture's horizontal axis" in head_on
    assert "about the picture's vertical axis" in head_on
    assert "the focal length is uncertain" in head_on
    assert "take some much nearer" in said(fitted(7, count=10, near=0.4, far=0.42))
    rng = np.random.default_rng(8)
    middle = [
        dataclasses.replace(drawn_pose(rng, near=0.6, far=0.9), position_m=np.array([0, 0, rng.uniform(0.6, 0.9)]))
        for _ in range(16)
    ]
    corner = said(fit_lens(BOARD, sightings(BOARD, middle, rng)))
    for part in ("upper left", "upper right", "lower left", "lower right"):
        assert part in corner


def test_advice_names_blurred_and_pale_pictures_and_those_without_a_board() -> None:
    rng = np.random.default_rng(9)
    pictures = sightings(BOARD, [drawn_pose(rng) for _ in range(16)], rng)
    first, second, *others = pictures.seen
    soft, pale = dataclasses.replace(first, blur_px=3.0), dataclasses.replace(second, contrast=30.0)
    fit = fit_lens(BOARD, Sightings(640, 480, (soft, pale, *others), ("cat", "dog")))
    assert "p00: blurred" in said(fit)
    assert "p01: pale" in said(fit)
    assert "no board found in cat, dog" in said(fit)


def test_too_little_is_refused_with_the_remedy() -> None:
    rng = np.random.default_rng(10)
    few = sightings(BOARD, [drawn_pose(rng) for _ in range(3)], rng)
    with pytest.raises(VisionError, match="is in 3 of 3 pictures, 4 are needed"):
        fit_lens(BOARD, few)
    flat = [Pose(np.eye(3), np.array([0.0, 0.0, 0.4])) for _ in range(6)]
    with pytest.raises(VisionError, match="tilt the board"):
        fit_lens(BOARD, sightings(BOARD, flat, rng))


def test_a_camera_file_survives_and_a_damaged_one_is_refused(tmp_path: Path) -> None:
    fit, file = fitted(11), tmp_path / "camera.json"
    write_camera(file, fit, BOARD.name, advice(fit), made_today())
    lens = read_camera(file)
    assert np.array_equal(lens.values, fit.lens.values)
    assert np.array_equal(lens.covariance, fit.lens.covariance)
    good = file.read_text()
    for wrong, says in (
        (good.replace('"camera/1"', '"camera/2"'), 'format: expected "camera/1"'),
        (good.replace('"fx":', '"focal":'), "lens.fx: expected a number, got None"),
        (good.replace('"width_px": 640', '"width_px": 0'), "width_px: expected a number from 1 to 100000, got 0"),
        ("{", "not JSON"),
    ):
        file.write_text(wrong)
        with pytest.raises(VisionError, match=says):
            read_camera(file)
