"""What is wrong with a log is said, and what still can be answered is."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calib.arrays import Array
from calib.gap.log import Log, LoggedRun
from calib.gap.series.find import DynamicOutcome, examine
from calib.gap.series.plausible import plausible
from calib.gap.signals.recording import RunSet, UnusableLogError, prepare
from control.kinematics.kinematics import ForwardKinematics
from tests.calib.gap.series.prescribed import arm_with_friction, log_of

ARM = arm_with_friction()
LOG = log_of(ARM)


def changed(change: Callable[[LoggedRun], LoggedRun], log: Log = LOG) -> Log:
    return Log(tuple(change(run) for run in log.runs))


def checked(change: Callable[[LoggedRun], LoggedRun]) -> RunSet:
    return plausible(ARM, prepare(ARM, changed(change)))


def said(recording: RunSet) -> str:
    return " ".join(recording.warnings)


def test_a_sound_log_keeps_every_channel_without_a_word() -> None:
    recording = checked(lambda run: run)
    assert recording.has_current
    assert recording.has_voltage
    assert recording.has_tip
    assert not recording.warnings


def test_placeholders_of_the_drives_are_said_and_what_the_log_shows() -> None:
    drives = tuple(replace(one, torque_constant_Nm_A=1.0, resistance_ohm=1.0) for one in ARM.drives)
    arm = replace(ARM, drives=drives)
    recording = plausible(arm, prepare(arm, LOG))
    assert "drives 1, 2, 3" in said(recording)
    assert re.search(r"the log shows 0\.0(29|30)", said(recording))
    assert (recording.has_current, recording.has_voltage, recording.has_tip) == (False, False, True)


def test_currents_in_milliamperes_are_said_and_not_used() -> None:
    recording = checked(lambda run: replace(run, current_A=1000.0 * run.current_A))
    assert "milliamperes" in said(recording)
    assert not recording.has_current


@pytest.mark.parametrize(
    ("factor", "word"), [(-1.0, "other sign"), (100.0 / ARM.drives[0].supply_V, "percent"), (1 / ARM.drives[0].supply_V, "share")]
)
def test_voltages_that_are_none_are_said_and_not_used(factor: float, word: str) -> None:
    recording = checked(lambda run: replace(run, voltage_V=factor * run.voltage_V))
    assert word in said(recording)
    assert not recording.has_voltage
    assert recording.has_current


def test_currents_of_the_other_sign_are_said_and_not_used() -> None:
    recording = checked(lambda run: replace(run, current_A=-run.current_A))
    assert "other sign" in said(recording)
    assert not recording.has_current


def test_a_sensor_that_never_speaks_is_said_and_not_used() -> None:
    recording = checked(lambda run: replace(run, current_A=np.zeros_like(run.current_A)))
    assert "i1_A is 0 throughout" in said(recording)
    assert not recording.has_current


def test_a_tip_in_millimetres_is_said_and_not_used() -> None:
    recording = checked(lambda run: replace(run, tip_m=1000.0 * run.tip_m))
    assert "millimetres" in said(recording)
    assert not recording.has_tip


def test_a_tip_in_another_frame_is_said_and_not_used() -> None:
    recording = checked(lambda run: replace(run, tip_m=run.tip_m + np.array([0.0, 0.9, 0.0])))
    assert "another frame" in said(recording)
    assert not recording.has_tip


def test_a_clock_in_milliseconds_is_refused() -> None:
    with pytest.raises(UnusableLogError, match="milliseconds"):
        checked(lambda run: replace(run, t_s=1000.0 * run.t_s))


def test_an_arm_that_stands_still_is_refused() -> None:
    with pytest.raises(UnusableLogError, match="no joint moves"):
        checked(lambda run: replace(run, q_rad=np.zeros_like(run.q_rad)))


def test_runs_of_three_samples_are_refused() -> None:
    names = ("t_s", "q_rad", "q_set_rad", "current_A", "voltage_V", "payload_kg", "tip_m")
    with pytest.raises(UnusableLogError, match="shorter than"):
        checked(lambda run: replace(run, **{name: getattr(run, name)[:3] for name in names}))


def late_camera() -> DynamicOutcome:
    """A tip that is 6 ms late, beside viscous friction that the arm's file lacks."""
    kinematics = ForwardKinematics(ARM)

    def late(run: LoggedRun) -> LoggedRun:
        seen = np.isfinite(run.tip_m[:, 0])
        earlier = np.stack([np.interp(run.t_s[seen] - 0.006, run.t_s, column) for column in run.q_rad.T], axis=1)
        tip = np.array(run.tip_m)
        tip[seen] += kinematics.tips(earlier) - kinematics.tips(run.q_rad[seen])
        return replace(run, tip_m=tip)

    def link_friction(j: int, q: Array, speed: Array, link: Array) -> Array:
        return np.asarray(0.6 * speed) if j == 1 else np.zeros_like(q)

    names = ("viscous_friction", "coulomb_friction", "encoder_scale", "joint_compliance")
    return examine(ARM, changed(late, log_of(ARM, link_friction)), candidates=names)


@pytest.mark.usefixtures("without_motion")
def test_a_late_camera_is_said_and_the_answer_given_all_the_same() -> None:
    outcome = late_camera()
    assert any(re.search(r"(5\.9|6\.0)\d ms late", text) for text in outcome.warnings)
    assert [str(effect.name) for effect in outcome.finding.effects] == ["viscous_friction on joint 2"]
    assert outcome.finding.unknown is None
    assert outcome.finding.gap_after < 1.3


def test_runs_without_the_driver_end_in_an_answer_and_a_sentence() -> None:
    def coasting(run: LoggedRun) -> LoggedRun:
        off = np.full_like(run.voltage_V, np.nan)
        return replace(run, voltage_V=off, current_A=np.zeros_like(run.current_A), is_commanded=True)

    outcome = examine(ARM, changed(coasting, Log(LOG.runs[:3])))
    assert any("voltage of joint 1" in sentence for sentence in outcome.warnings)
