"""Recordings of real machines: no law is named that held-out runs do not bear out."""

from __future__ import annotations

from dataclasses import replace

import pytest

from calib.gap.finding import EffectName
from calib.gap.log import Log, read_log
from calib.gap.poses.find import find as find_in_poses
from calib.gap.series.find import DynamicOutcome, examine
from calib.points.points import read_points
from control.model.arm import Effect
from control.model.description import load_arm
from tests.places import REAL

pytestmark = pytest.mark.usefixtures("without_motion")

COULOMB, VISCOUS = EffectName("coulomb_friction", 1), EffectName("viscous_friction", 1)
GEOMETRY = ("link_geometry", "base_frame")


@pytest.fixture(scope="module")
def servo_log() -> Log:
    return read_log(REAL / "bam_xl330" / "log.csv.gz", 1)[0]


@pytest.fixture(scope="module")
def servo(servo_log: Log) -> DynamicOutcome:
    return examine(load_arm(REAL / "bam_xl330" / "arm.toml"), servo_log)


def test_a_real_servos_coulomb_friction_is_named(servo: DynamicOutcome) -> None:
    effect = next(e for e in servo.finding.effects if e.name == COULOMB)
    torque_Nm, sd_Nm = effect.parameters["torque_Nm"]
    assert torque_Nm == pytest.approx(0.07, rel=0.3)  # all sixteen published runs give 0.075, these twelve 0.062
    assert sd_Nm < 0.2 * torque_Nm
    assert servo.finding.gap_after < 0.9 * servo.finding.gap_before  # on runs that nothing was fitted to


def test_no_richer_law_is_named_than_held_out_runs_support(servo: DynamicOutcome) -> None:
    assert {effect.name for effect in servo.finding.effects} <= {COULOMB, VISCOUS}
    assert all(effect.probability > 0.95 for effect in servo.finding.effects)


def test_what_coulomb_friction_leaves_of_the_servos_gap_is_unknown(servo: DynamicOutcome) -> None:
    """The servo's friction depends on load, speed and more; the honest answer is that something is left, and where."""
    unknown = servo.finding.unknown
    assert unknown is not None
    assert "joint 1" in unknown.where


def test_a_servo_without_current_sensor_is_not_said_to_have_one(servo: DynamicOutcome) -> None:
    assert "tip_m" not in servo.finding.noise_floor
    assert "voltage_V" not in servo.finding.noise_floor
    assert any("no run repeats another" in text for text in servo.warnings)


@pytest.mark.nightly  # the arms of all other logs know their friction, and none is named on them
def test_friction_that_the_file_has_already_is_not_named_again(servo: DynamicOutcome, servo_log: Log) -> None:
    arm = load_arm(REAL / "bam_xl330" / "arm.toml")
    found = next(e for e in servo.finding.effects if e.name == COULOMB)
    friction = Effect("coulomb_friction", 1, {"torque_Nm": found.parameters["torque_Nm"][0]})
    again = examine(replace(arm, effects=(friction,)), servo_log).finding
    assert COULOMB not in {effect.name for effect in again.effects}
    assert again.gap_before < servo.finding.gap_before


def test_nothing_false_is_named_on_a_real_arms_poses() -> None:
    folder = REAL / "mukca_panda_1"
    arm = load_arm(folder / "arm.toml")
    found = find_in_poses(arm, read_points(folder / "points.csv", arm.joint_count)[0]).finding
    assert [e.name for e in found.effects if e.name.effect not in GEOMETRY] == []
