"""Episodes are the motions of a recording, at a steady rate."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from console.lerobot_dataset import Episode, episodes_of
from console.visualisation.reading import read_series
from console.visualisation.series import Series
from control.errors import ArmError
from control.kinematics.kinematics import ForwardKinematics
from control.model.description import arm_text, load_arm
from tests.recordings import MODES, write_recording

ARM = load_arm("right")
HOLDING, MOVING, STOPPING, GUIDING = (MODES.index(name) for name in ("HOLDING", "MOVING", "STOPPING", "GUIDING"))


def series_of(path: Path, cycles: int, changes: dict[int, dict[str, float]] | None = None) -> Series:
    return read_series(write_recording(path / "a.armlog", cycles, 3, changes, arm_toml=arm_text(ARM)))


def rows_of(episode: Episode, series: Series) -> list[int]:
    """The rows of the recording that the samples are; its set-points rise for 125 cycles."""
    return [int(np.abs(series.joint_set_rad[:, 0] - wanted).argmin()) for wanted in episode.joint_set_rad[:, 0]]


def test_each_run_with_a_motion_is_an_episode_without_what_was_held(tmp_path: Path) -> None:
    modes = {k: {"mode": HOLDING, "run": 1} for k in range(40, 60)}
    modes |= {k: {"mode": MOVING, "run": 2} for k in range(60, 80)} | {80: {"mode": STOPPING, "run": 2}}
    modes |= {k: {"mode": GUIDING, "run": 2} for k in range(81, 90)}
    modes |= {k: {"mode": GUIDING, "run": 3} for k in range(90, 100)}
    series = series_of(tmp_path, 100, modes)
    first, second = episodes_of(series, 100)
    assert rows_of(first, series) == list(range(10, 40, 5))
    assert rows_of(second, series) == list(range(60, 81, 5))
    assert (first.source, second.source) == ("a.armlog, run 1", "a.armlog, run 2")


def test_a_sample_is_state_currents_set_point_and_tip_of_one_cycle(tmp_path: Path) -> None:
    series = series_of(tmp_path, 100)
    (episode,) = episodes_of(series, 50)
    rows = rows_of(episode, series)
    assert len(episode) == len(rows) == 9
    np.testing.assert_array_equal(episode.joint_rad, series.joint_rad[rows])
    np.testing.assert_array_equal(episode.current_A, series.current_A[rows])
    np.testing.assert_allclose(episode.tip_m, ForwardKinematics(ARM).tips(series.joint_rad[rows]), atol=1e-12)


def test_without_modes_an_episode_is_a_whole_run(tmp_path: Path) -> None:
    series = replace(series_of(tmp_path, 40), mode=np.full(40, -1), modes=())
    before, after = episodes_of(series, 500)
    assert (len(before), len(after)) == (10, 30)


def test_cycles_that_begin_late_do_not_shift_samples(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    begun_s = 5000.0 + 0.002 * np.arange(120) + random.uniform(0.0, 4e-4, 120)
    series = series_of(tmp_path, 120, {k: {"t_s": t_s} for k, t_s in enumerate(begun_s.tolist())})
    (episode,) = episodes_of(series, 50)
    assert rows_of(episode, series) == list(range(10, 120, 10))


def test_where_values_are_missing_the_last_ones_are_held(tmp_path: Path) -> None:
    series = series_of(tmp_path, 100, {k: {"i2_A": math.nan} for k in range(28, 43)})
    (episode,) = episodes_of(series, 100)
    assert rows_of(episode, series) == [10, 15, 20, 25, 27, 27, 27, *range(45, 100, 5)]


def test_a_rate_above_the_recorded_one_and_an_unknown_arm_are_one_error(tmp_path: Path) -> None:
    series = series_of(tmp_path, 30)
    assert len(next(episodes_of(series, 500))) == 20
    with pytest.raises(ArmError, match="expected at most the recorded 500 Hz, got 501"):
        next(episodes_of(series, 501))
    unknown = read_series(write_recording(tmp_path / "b.armlog", 30, arm="nobody's"))
    with pytest.raises(ArmError, match=r"b\.armlog: its arm is unknown: give it with --arm"):
        next(episodes_of(unknown, 50))
