"""The watch over a session's records: good ones are let be, a tip beside its cavity is seen, and what it takes for that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.calibration.chains import REFERENCE, REFERENCE_DH, board_points, board_session
from calib.arm_problem.observations import rotation_of
from calib.session.residual_watch import ResidualWatch, TipObservation
from control.model.arm import Effect
from tests.calib.session.session_arm import RIGHT

BOARD = board_points() - np.array([0.5, 0.0, 0.0])
BESIDE = np.array([0.005, 0.0, 0.0])


def judged(seed: int, is_unknown: bool, play_rad: float = 0.0):
    """Of a session on two tilts: surprise of every record, and of the same tip 5 mm beside, with how many were before."""
    rng = np.random.default_rng(seed)
    _, q_rad, tips, names = board_session(rng, setups=("normal", "roll"), noise_m=1e-4)
    q_rad = q_rad + rng.choice([-0.5, 0.5], q_rad.shape) * play_rad
    watch, good, beside = ResidualWatch(RIGHT), [], []
    for k in range(0, 66, 2):
        place = BOARD[k % 33] + rng.normal(0.0, 1e-4, 3) if is_unknown else tips[k]
        here, there = (TipObservation(names[k], tuple(q_rad[k]), tuple(p), is_unknown) for p in (place, place + BESIDE))
        good.append(watch.judge(here).off_sd)
        beside.append(watch.judge(there).is_suspect)
        watch.add(k, here)
    return np.array(good), np.array(beside)


@pytest.mark.parametrize(("is_unknown", "play_rad"), [(False, 0.0), (False, 0.005), (True, 0.0)])
def test_good_records_are_never_suspect_also_with_play(is_unknown: bool, play_rad: float) -> None:
    """The limit is six standard deviations; 66 good records stay below five."""
    for seed in range(2):
        good, _ = judged(seed, is_unknown, play_rad)
        assert np.nanmax(good) < 5.0
        assert np.isnan(good[: 4 if is_unknown else 2]).all(), "too few before"


def test_a_tip_5_mm_beside_its_cavity_shows_from_the_fifth_record_on() -> None:
    for seed in range(2):
        assert judged(seed, is_unknown=False)[1][4:].all()


def test_what_table_and_camera_call_base_may_be_another_frame() -> None:
    """An arm that stands 30 mm and 0.1 rad beside, which its base_frame effect says: no error, no surprise."""
    turn, shift = np.array([0.0, 0.1, -0.05]), np.array([0.03, 0.0, -0.02])
    names = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
    effect = Effect("base_frame", None, dict(zip(names, (*shift, *turn), strict=True)))
    watch = ResidualWatch(replace(RIGHT, effects=(effect,)))
    q_rad = np.random.default_rng(1).uniform((-0.3, -1.2, -0.1), (0.3, -0.8, 0.4), (8, 3))
    seen = (REFERENCE.tips(REFERENCE_DH, q_rad) - shift) @ rotation_of(turn)
    for q, tip in zip(q_rad, seen, strict=True):
        verdict = watch.judge(TipObservation("free", tuple(q), tuple(tip)))
        np.testing.assert_allclose(verdict.error_m, 0.0, atol=1e-12)
        assert not verdict.off_sd > 1e-6
        watch.add(tuple(q), TipObservation("free", tuple(q), tuple(tip)))
