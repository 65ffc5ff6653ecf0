"""A log with the boards' time stamps, and what a motion capture system saw of it: all on one clock."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest

from calib.capture.alignment import JointMotion, align
from calib.capture.tracks import BodyTrack
from calib.gap.log import Log, LoggedRun
from control.kinematics.kinematics import ForwardKinematics
from procedures.gap_timing import NO_STAMPS, on_one_clock, with_tips
from tests.procedures.gap.test_gap_timing import ARM, RUNS, PERIOD_s, angle

KINEMATICS = ForwardKinematics(ARM)
CAPTURE_s = 41.37  # when the capture begins, on the loop's clock


def log_of(has_stamps: bool = True) -> Log:
    """As `export` writes it: each run from 0, the cycle and the stamps of the boards beside the rows."""
    runs = []
    for number, raw in enumerate(RUNS, 1):
        extra = {"cycle": tuple(f"{v:.0f}" for v in raw.t_s / PERIOD_s)}
        for j in range(3 if has_stamps else 0):
            extra[f"counted{j + 1}_s"] = tuple(f"{v:.12g}" for v in raw.counted_s[:, j])
        run = LoggedRun(
            str(number),
            raw.t_s - raw.t_s[0],
            raw.q_rad,
            raw.q_set_rad,
            raw.current_A,
            raw.voltage_V,
            np.zeros(len(raw.t_s)),
            np.full((len(raw.t_s), 3), np.nan),
            MappingProxyType(extra),
            True,
        )
        runs.append(run)
    return Log(tuple(runs), ("log.csv",))


def captured() -> tuple[np.ndarray, np.ndarray]:
    """Times of a capture at 120 Hz, and the tips with 0.14 mm of noise."""
    tau = np.arange(round(4.0 * 120)) / 120
    noise = np.random.default_rng(4).normal(0.0, 1.4e-4, (len(tau), 3))
    return tau, KINEMATICS.tips(angle(CAPTURE_s + tau)) + noise


def test_the_age_of_the_angles_is_not_taken_for_a_time_of_the_capture() -> None:
    tau, tips = captured()
    late = align(ARM, JointMotion.of(log_of(), None)[0], tau, BodyTrack(tips))
    log, said = on_one_clock(ARM, log_of(), None)
    alignment = align(ARM, JointMotion.of(log, None)[0], tau, BodyTrack(tips))
    true_s = CAPTURE_s - RUNS[0].t_s[0]
    assert late.offset_s - true_s > 1e-3  # half a cycle or more, and the way of the report
    assert alignment.offset_s - true_s == pytest.approx(0.0, abs=6e-5)
    assert "angles 1." in said[0]


def test_tips_stand_at_the_rows_of_their_time() -> None:
    log, _ = on_one_clock(ARM, log_of(), None)
    motion, _ = JointMotion.of(log, None)
    tau, _ = captured()
    seen = KINEMATICS.tips(angle(CAPTURE_s + tau))
    seen[30:60] = np.nan
    run, *others = with_tips(ARM, log, motion, CAPTURE_s - RUNS[0].t_s[0] + tau, seen).runs
    at = np.flatnonzero(np.isfinite(run.tip_m[:, 0]))
    assert len(at) == len(tau) - 30
    assert not any(np.isfinite(one.tip_m).any() for one in others)
    true = KINEMATICS.tips(angle(run.t_s[at] + RUNS[0].t_s[0]))
    assert np.abs(run.tip_m[at] - true).max() < 2e-4  # 1 ms of a speed that is off by 0.1 m/s
    assert np.sqrt(np.mean((run.tip_m[at] - true) ** 2)) < 3e-5


def test_a_log_without_stamps_or_with_stamps_that_jump_stays_as_it_is_and_that_is_said() -> None:
    jumps = log_of()
    stamps = list(jumps.runs[0].extra["counted2_s"])
    stamps[100:] = ["7.5"] * (len(stamps) - 100)
    first, *others = jumps.runs
    wrong = [{**first.extra, "counted2_s": column} for column in (tuple(stamps), ("x",) * len(stamps))]
    logs = [replace(jumps, runs=(replace(first, extra=MappingProxyType(one)), *others)) for one in wrong]
    for log in (log_of(has_stamps=False), *logs):
        found, said = on_one_clock(ARM, log, None)
        assert said == (NO_STAMPS,)
        assert found.runs == log.runs
