"""What is hidden in prescribed motions is named, what is in no list is unknown, and nothing is found in nothing.

The parameters' tolerances are the issue's 10 %; motions of 2 s with the noise of the reference arm's sensors give far less.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.arm_problem.arm_model import dh_names
from calib.arm_problem.assembly import BASE_FRAME, Choice, problem_of
from calib.arm_problem.observations import Frame, rotation_of
from calib.arrays import Array
from calib.calibration import calibrated_arm
from calib.gap.finding import EffectName, GapFinding, as_totals
from calib.gap.log import Log, LoggedRun
from calib.gap.series.find import DynamicOutcome, examine, find
from calib.gap.signals.recording import UnusableLogError
from calib.identify.identification import identify
from calib.identify.objective import LeastSquares
from calib.points.points import Points
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Effect
from tests.calib.gap.series.prescribed import Hidden, arm_with_friction, log_of
from tests.thirds import third_of

pytestmark = pytest.mark.usefixtures("without_motion")

ARM = arm_with_friction()
FEW = ("coulomb_friction", "viscous_friction", "load_friction", "cogging", "stribeck_friction", "torque_constant")


def on_joint(joint: int, law: Hidden) -> Hidden:
    return lambda j, q, speed, link: law(j, q, speed, link) if j == joint - 1 else np.zeros_like(q)


def names(found: GapFinding) -> list[EffectName]:
    return [effect.name for effect in found.effects]


@pytest.fixture(scope="module")
def told() -> list[float]:
    """The shares of the work that `null` has told of."""
    return []


@pytest.fixture(scope="module")
def null(told: list[float]) -> DynamicOutcome:
    return examine(ARM, log_of(ARM), lambda what, share: told.append(share))


def test_nothing_is_found_where_nothing_is_hidden(null: DynamicOutcome) -> None:
    found = null.finding
    assert not found.effects
    assert not found.ambiguous
    assert found.unknown is None
    assert found.gap_before == found.gap_after == pytest.approx(1.0, abs=0.1)


def test_the_floor_of_every_channel_is_what_its_sensors_leave(null: DynamicOutcome) -> None:
    assert null.finding.noise_floor["tip_m"] == pytest.approx(0.00014, rel=0.1)
    assert 0.002 < null.finding.noise_floor["current_A"] < 0.005
    assert null.rows.floor_source == "repeats"


def test_what_the_recording_could_name_is_said_for_every_effect(null: DynamicOutcome) -> None:
    listed = {one.name: one.detectability for one in null.finding.nameable}
    assert listed[EffectName("load_friction", 2)] > 10.0
    assert listed[EffectName("command_delay")] > 10.0
    assert EffectName("backlash", 3) in listed


def test_repeats_stay_together_and_reporting_runs_decide_nothing(null: DynamicOutcome) -> None:
    assert null.split.report_runs in (("2", "7"), ("3", "6"))
    assert not np.any(null.split.deciding & null.split.reporting)
    for group in null.split.groups:
        assert not np.any(group & null.split.reporting)


def test_progress_is_told_from_the_start_to_the_last_step(null: DynamicOutcome, told: list[float]) -> None:
    assert told[0] == 0.0
    assert 0.9 < told[-1] < 1.0
    assert told == sorted(told)


@pytest.mark.parametrize("order", third_of([7, 1]))
def test_cogging_and_an_eccentric_encoder_are_named_from_currents_and_from_the_tip(order: int) -> None:
    def turned(q: Array, gravity: Array) -> Array:
        ahead = np.zeros_like(q)
        ahead[:, 2] = 0.004 * np.sin(q[:, 2] + 0.5)
        return ahead

    log = log_of(ARM, on_joint(1, lambda j, q, speed, link: 0.4 * np.sin(order * 100.0 * q + 0.8)), turned=turned)
    found = find(ARM, log, candidates=(*FEW, "encoder_eccentricity", "encoder_scale", "belt_coupling"))
    assert names(found) == [EffectName("cogging", 1), EffectName("encoder_eccentricity", 3)]
    cogging, eccentric = ({name: value for name, (value, _) in one.parameters.items()} for one in found.effects)
    assert cogging["order"] == order
    assert cogging["amplitude_Nm"] == pytest.approx(0.4, rel=0.1)
    assert cogging["phase_rad"] == pytest.approx(0.8, abs=0.1)
    assert eccentric["amplitude_rad"] == pytest.approx(0.004, rel=0.1)
    assert eccentric["phase_rad"] == pytest.approx(0.5, abs=0.1)
    assert found.gap_after < 1.1


def test_two_effects_on_two_joints_are_both_named_and_drawn_over_their_own_variables_beside_the_data() -> None:
    def law(j: int, q: Array, speed: Array, link: Array) -> Array:
        if j == 0:
            return np.asarray(0.5 * speed)
        return np.asarray(0.15 * np.abs(link) * np.sign(speed)) if j == 2 else np.zeros_like(q)

    outcome = examine(ARM, log_of(ARM, law), candidates=FEW)
    assert set(names(outcome.finding)) == {EffectName("viscous_friction", 1), EffectName("load_friction", 3)}
    assert outcome.finding.gap_after < 1.3
    (drawn,) = (one for one in outcome.laws if one.name == EffectName("viscous_friction", 1))
    drive, fast = ARM.drive(1), np.abs(drawn.at) > 0.1
    size_mA = 1e3 * 0.5 * drawn.at / (drive.gear_ratio * drive.torque_constant_Nm_A)
    assert (drawn.variable, drawn.unit) == ("speed of joint 1 [rad/s]", "mA")
    assert drawn.law[fast] == pytest.approx(size_mA[fast], rel=0.1)
    assert float(np.std(drawn.data - drawn.whole)) < 0.05 * float(np.std(size_mA))
    (drawn,) = (one for one in outcome.laws if one.name == EffectName("load_friction", 3))
    assert (drawn.variable, drawn.unit) == ("transmitted torque of joint 3 [N m]", "mA")


def test_an_effect_that_is_taken_off_the_list_is_unknown_and_not_its_neighbour() -> None:
    log = log_of(ARM, on_joint(2, lambda j, q, speed, link: 0.2 * np.abs(link) * np.sign(speed)))
    found = find(ARM, log, candidates=[name for name in FEW if name != "load_friction"])
    assert not found.effects
    assert found.unknown is not None
    assert "joint 2" in found.unknown.where


def test_a_late_command_is_named_and_not_an_inductance() -> None:
    found = find(ARM, log_of(ARM, delay_samples=1), candidates=(*FEW, "command_delay", "supply_sag"))
    assert names(found) == [EffectName("command_delay")]
    assert found.effects[0].parameters["delay_s"][0] == pytest.approx(0.002, rel=0.1)


def test_a_sag_that_the_file_has_in_part_comes_out_as_its_total_in_the_form_that_the_supply_keeps() -> None:
    """The supply gives way to the sum of all currents' magnitudes; arm.toml does not say that."""
    sag_ohm = 1.0
    nominal_V = np.array([drive.supply_V for drive in ARM.drives])

    def sagging(run: LoggedRun) -> LoggedRun:
        there = 1.0 - sag_ohm * np.abs(run.current_A).sum(axis=1, keepdims=True) / nominal_V
        return replace(run, voltage_V=run.voltage_V / there)

    log = log_of(ARM)
    log = replace(log, runs=tuple(sagging(run) for run in log.runs))
    half = replace(ARM, effects=(*ARM.effects, Effect("supply_sag", None, {"resistance_ohm": 0.5 * sag_ohm})))
    (effect,) = as_totals(half, find(half, log, candidates=("supply_sag",))).effects
    assert effect.name == EffectName("supply_sag", None)
    value, _ = effect.parameters["resistance_ohm"]
    assert value == pytest.approx(sag_ohm, rel=0.1)


def test_another_winding_resistance_is_unknown_as_it_is_in_no_list() -> None:
    found = find(ARM, log_of(ARM, winding_share=0.2), candidates=(*FEW, "supply_sag"))
    assert not found.effects
    assert found.unknown is not None
    assert "resistance" in found.unknown.where


def changed(log: Log, change: object) -> Log:
    return Log(tuple(change(run) for run in log.runs))  # type: ignore[operator]


def test_degrees_are_recognised() -> None:
    with pytest.raises(UnusableLogError, match="look like degrees"):
        find(ARM, changed(log_of(ARM), lambda run: replace(run, q_rad=np.rad2deg(run.q_rad))))


def test_another_arms_log_is_recognised() -> None:
    with pytest.raises(UnusableLogError, match="has 3"):
        find(ARM, changed(log_of(ARM), lambda run: replace(run, q_rad=run.q_rad[:, :2])))


def test_a_gap_and_a_saturated_current_are_said_and_their_samples_not_used() -> None:
    def cut(run: LoggedRun) -> LoggedRun:
        if run.name != "5":
            return run
        keep = np.ones(len(run), dtype=bool)
        keep[900:960] = False
        current = np.array(run.current_A)
        current[600:610, 0] = 8.0
        fields = ("t_s", "q_rad", "q_set_rad", "voltage_V", "payload_kg", "tip_m")
        return replace(run, current_A=current[keep], **{name: getattr(run, name)[keep] for name in fields})

    outcome = examine(ARM, changed(log_of(ARM), cut), candidates=("coulomb_friction",))
    said = " ".join(outcome.warnings)
    assert "run 5: 1 gaps, the longest 0.122 s" in said
    assert "drive 1 is at its limit" in said
    assert not outcome.finding.effects
    assert outcome.finding.unknown is None


def test_one_run_alone_is_said_and_judged_by_its_parts() -> None:
    log = log_of(ARM, on_joint(2, lambda j, q, speed, link: 0.3 * np.abs(link) * np.sign(speed)))
    outcome = examine(ARM, Log(log.runs[1:2]), candidates=FEW)
    assert any("one run only" in text for text in outcome.warnings)
    assert not any(name.joint != 2 for name in names(outcome.finding))


def test_a_tip_that_warms_up_is_named_with_its_joint_and_time() -> None:
    def warm(run: LoggedRun) -> LoggedRun:
        seen = np.isfinite(run.tip_m[:, 0])
        turned = np.array(run.q_rad[seen])
        turned[:, 1] += 0.004 * (1.0 - np.exp(-run.t_s[seen] / 1.5))
        tip = np.array(run.tip_m)
        tip[seen] += ForwardKinematics(ARM).tips(turned) - ForwardKinematics(ARM).tips(run.q_rad[seen])
        return replace(run, tip_m=tip)

    found = find(ARM, changed(log_of(ARM), warm), candidates=("thermal_drift", "encoder_scale"))
    assert names(found) == [EffectName("thermal_drift", 2)]
    assert found.effects[0].parameters["final_rad"][0] == pytest.approx(0.004, rel=0.1)
    value_s, sd_s = found.effects[0].parameters["time_constant_s"]
    assert abs(value_s - 1.5) < 2.0 * sd_s < 0.45  # runs of 2 s


def test_a_frame_that_motions_name_is_the_total_that_calibrate_places_from_the_same_tips() -> None:
    vector = (0.4, -0.2, 0.1, 0.1, -0.3, 0.8)  # of the file, as docs/formats.md has it; the camera has moved since
    there = Frame("camera", rotation_of(np.array([0.106, -0.304, 0.797])), np.array([0.403, -0.204, 0.098]))
    arm = replace(ARM, effects=(*ARM.effects, Effect("base_frame", None, dict(zip(BASE_FRAME, vector, strict=True)))))
    log = log_of(ARM)
    runs = [replace(run, tip_m=(run.tip_m - there.origin_m) @ there.rotation) for run in log.runs]
    found = find(arm, replace(log, runs=tuple(runs)), candidates=("base_frame",))
    assert names(found) == [EffectName("base_frame")]
    assert found.gap_after < 1.1 < found.gap_before

    seen = [np.isfinite(run.tip_m[:, 0]) for run in runs]
    q, tip = (np.concatenate([getattr(run, k)[rows] for run, rows in zip(runs, seen, strict=True)]) for k in ("q_rad", "tip_m"))
    m, nothing = len(q), np.full((len(q), 3), np.nan)
    points = Points(("free",) * m, ("p",) * m, tuple(range(m)), q, tip, np.zeros((m, 3)), nothing, nothing[:, 0], nothing[:, 0])
    choice = Choice(freed=("base",), fixed=dh_names(len(arm.links)))
    placed = calibrated_arm(arm, identify(problem_of(arm, points, choice), objective=LeastSquares()), points)
    (frame,) = (one for one in placed.effects if one.effect == "base_frame")
    (named,) = found.effects
    assert {key: value for key, (value, _) in named.parameters.items()} == pytest.approx(dict(frame.parameters), abs=1e-4)
    np.testing.assert_allclose([v for v, _ in named.parameters.values()], (*there.origin_m, 0.106, -0.304, 0.797), atol=2e-4)
