"""Tuning: the signal and what is read from it, the whole of it on a mock joint, and what makes it refuse."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from console.main import main
from control.dynamics.gains import MarginsUnmet, MotorFit, gains_of
from control.errors import ArmError
from control.model.arm import DrivePid
from hil_mocks.rig import SteppedRig
from hil_mocks.scenario import FaultTable
from procedures import tuning, tuning_session
from procedures import tuning_session as signal
from procedures.on_boards import on_boards
from procedures.tuning import NotTuned, TuningOptions, inertia_ratios, tune, write_report
from procedures.tuning_session import MeasuredResponse, PoorResponse, evaluate, multisine, usable
from tests.cell import RIGHT, scenario, wired_to, with_drive, with_drives

pytestmark = pytest.mark.usefixtures("nobody_below")

WAVE = multisine(2.0, 500.0)
MOTOR = MotorFit(40.0, 120.0, 0.003, 0.0)


def answered(noise_rad: float = 0.0, bend: float = 0.0, passes: int = 4) -> MeasuredResponse:
    """A linear motor's answer to the signal, in periods, with noise and a cubic part of the angle."""
    spectrum = np.fft.rfft(WAVE.samples)
    omega = 2.0 * np.pi * np.arange(len(spectrum)) / 2.0
    omega[0] = 1.0
    angle = np.fft.irfft(spectrum * MOTOR.response(omega), len(WAVE.samples))
    angle = angle + bend * angle**3 / np.abs(angle).max() ** 2
    angle, wave = (np.append(period, period[: signal.BEYOND]) for period in (angle, WAVE.samples))
    random = np.random.default_rng(3)
    rows = angle + noise_rad * random.normal(size=(passes, len(angle))) + 0.4e-3 * np.arange(len(angle))
    outputs = np.tile(wave, (passes, 1))
    return evaluate(WAVE, rows, outputs, outputs)


def test_a_board_that_closes_the_position_loop_itself_is_not_tuned() -> None:
    arm = on_boards(RIGHT, "mixed")
    assert tuning.tunable(arm) == (1, 2)
    with SteppedRig(arm, scenario()) as rig, pytest.raises(NotTuned, match="joint 3 closes the position loop"):
        tune(wired_to(arm, rig), rig.clock, TuningOptions((1, 3)), lambda what, share: None)


@pytest.mark.parametrize(
    ("reached", "kept"), [((20.0, 60.0), (2.0, 10.0)), ((20.0, 50.0), (2.0, 0.0)), ((7.0, 60.0), (0.0, 0.0))]
)
def test_where_delay_leaves_no_reserve_of_phase_that_of_gain_is_kept(
    reached: tuple[float, float], kept: tuple[float, float]
) -> None:
    class Best:
        def fastest(self, gain_dB: float, phase_deg: float) -> tuple[float, float]:
            if gain_dB > reached[0] or phase_deg > reached[1]:
                raise MarginsUnmet("none")
            return gain_dB, phase_deg

    design, reserve = tuning._fastest(Best())
    assert reserve == kept
    assert design == (tuning.LEAST_GAIN_dB + kept[0], tuning.LEAST_PHASE_deg + kept[1])


def test_the_signal_is_of_odd_harmonics_with_some_left_out_and_no_high_peak() -> None:
    assert np.all(WAVE.lines % 2 == 1)
    assert np.all(WAVE.silent % 2 == 1)
    assert not set(WAVE.lines) & set(WAVE.silent)
    assert len(WAVE.silent) >= 4
    power = np.abs(np.fft.rfft(WAVE.samples))
    assert power[WAVE.silent].max() < 1e-9 * power[WAVE.lines].min()
    assert np.abs(WAVE.samples).max() == pytest.approx(1.0)
    assert WAVE.samples.std() > 0.35  # a sine has 0.71, noise of this many lines 0.25


def test_the_response_of_a_steadily_moving_joint_is_that_of_the_joint() -> None:
    found = answered()
    omega = found.response.omega_rad_s
    assert np.abs(found.response.plant / MOTOR.response(omega) - 1.0).max() < 1e-3
    assert found.noise < 1e-6
    assert found.distortion < 1e-3


def test_noise_and_bends_are_told_apart() -> None:
    noisy, bent = answered(noise_rad=1e-4), answered(bend=0.3)
    assert noisy.noise > 0.02
    assert bent.noise < 1e-6
    assert bent.distortion > 0.03
    assert bent.distortion > 3.0 * answered().distortion


def test_a_poor_response_is_refused_with_what_to_do() -> None:
    usable(answered(), 0.9)
    with pytest.raises(PoorResponse, match=r"coherence reaches 0\.9 at .* give a larger --amplitude"):
        usable(answered(noise_rad=3e-3), 0.9)


@pytest.mark.parametrize(("side", "bend", "is_tuned"), [("motor", 1.0, True), ("joint", 0.0, True), ("joint", 1.0, False)])
def test_a_joint_whose_encoder_is_behind_play_is_not_tuned_by_its_response(side: str, bend: float, is_tuned: bool) -> None:
    arm = with_drive(RIGHT, 1, encoder_on=side)
    good = usable(answered(bend=bend), 0.9)
    before = cast(Any, SimpleNamespace(gains=gains_of(arm, 1), measured=good))
    assert (good.distortion > tuning.NOT_LINEAR) is (bend > 0.0)
    context = nullcontext() if is_tuned else pytest.raises(NotTuned, match="behind the gear: it has play or friction")
    with context:
        tuning._designed(arm, 1, before, TuningOptions((1,)), (0.0, 0.15, 0.75))


def test_inertias_are_relative_to_those_of_the_pose() -> None:
    least, here, largest = inertia_ratios(RIGHT, 1, (0.0, 0.15, 0.75))
    assert least <= here == 1.0 < largest
    massless = replace(RIGHT, links=tuple(replace(link, mass_kg=None) for link in RIGHT.links))
    assert inertia_ratios(massless, 1, (0.0, 0.0, 0.0)) == (1.0,)


@pytest.fixture
def _two_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tuning_session, "PASSES", 2)


HOMED = scenario(None, base="demo")


@pytest.mark.usefixtures("_two_passes")
def test_a_joint_is_tuned_and_what_was_designed_is_what_is_there(tmp_path: Path) -> None:
    with SteppedRig(RIGHT, HOMED) as rig:
        result = tune(wired_to(RIGHT, rig), rig.clock, TuningOptions((3,)), lambda what, done: None)
        assert all(board.state.name == "SWITCH_ON_DISABLED" for board in rig.robot.motor_boards)
    (tuned,) = result.joints
    assert tuned.design.worst.meet(8.0, 55.0)
    assert tuned.after.margins.gain_dB == pytest.approx(tuned.design.here.gain_dB, abs=1.5)
    assert tuned.after.margins.phase_deg == pytest.approx(tuned.design.here.phase_deg, abs=5.0)
    assert tuned.after.margins.crossover_rad_s > tuned.before.margins.crossover_rad_s
    assert tuned.after.step.settling_s < tuned.before.step.settling_s
    pids = [drive.pid for drive in result.arm.drives]
    assert pids[:2] == [DrivePid(), DrivePid()]
    assert (pids[2].kp, pids[2].ki, pids[2].kd) == (tuned.design.gains.kp, tuned.design.gains.ki, tuned.design.gains.kd)
    write_report(result, tmp_path / "page.html", "a test")
    page = (tmp_path / "page.html").read_text("utf-8")
    assert page.count("<svg") == 4
    assert "least favourable inertia" in page


def test_a_joint_without_room_is_refused_before_anything_moves() -> None:
    arm = with_drive(RIGHT, 3, joint_upper_rad=1.0)
    with SteppedRig(RIGHT, HOMED) as rig:
        before = rig.clock.now_s()
        with pytest.raises(NotTuned, match=r"joint 3: not enough range at 0\.75 rad"):
            tune(wired_to(arm, rig), rig.clock, TuningOptions((3,)), lambda what, done: None)
        assert rig.clock.now_s() == before


def test_a_fault_ends_it_and_the_drives_are_off() -> None:
    fault = FaultTable("silent", "encoder", at_s=1.5)
    with SteppedRig(RIGHT, scenario(None, base="demo", fault=(fault,))) as rig:
        with pytest.raises(ArmError):
            tune(wired_to(RIGHT, rig), rig.clock, TuningOptions((3,)), lambda what, done: None)
        rig.clock.wait_until_s(rig.clock.now_s() + 0.3)
        assert all(board.state.name != "ENABLED" for board in rig.robot.motor_boards)


def test_a_board_that_runs_the_pid_is_measured_in_voltage_mode_and_keeps_its_own() -> None:
    arm = with_drives(RIGHT, pid=DrivePid("position"))
    assert {d.pid.mode for d in tuning.in_voltage_mode(arm).drives} == {"voltage"}
    gains = tuning.with_gains(arm, {1: tuning.gains_of(RIGHT, 1)})
    assert [d.pid.mode for d in gains.drives] == ["position"] * 3
    assert gains.drive(1).pid.kp is not None
    assert gains.drive(2).pid.kp is None


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--joint", "9"], "--joint 9: the arm has joints 1, 2, 3"),
        (["--bandwidth", "500"], "--bandwidth: expected 2 to 40 Hz"),
        (["--amplitude", "3"], "--amplitude: expected 0.02 to 0.8"),
        (["--pose", "0", "0"], "--pose: expected 3 joint angles"),
        (["--scenario", "nowhere"], "there is no such file"),
    ],
)
def test_wrong_input_is_one_message(options: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tune", "--mock", "--out", str(tmp_path / "new.toml"), *options]) == 2
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_nothing_that_is_there_is_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "new_report.html").write_text("old")
    assert main(["tune", "--mock", "--out", str(tmp_path / "new.toml")]) == 2
    assert "is never overwritten" in capsys.readouterr().err
    assert math.isclose(signal.PERIOD_S * 500.0, len(WAVE.samples))
