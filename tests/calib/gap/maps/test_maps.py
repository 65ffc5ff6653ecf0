"""Maps: what has no name is corrected where that helps poses and runs that were not fitted, and is never called a name."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.gap.static.cases import ARM, Hidden, case
from calib.arm_problem.joint_effects import along, known_corrections, node_values, spline_columns
from calib.gap.finding import EffectName
from calib.gap.maps.choose import CHECKED_sd, helps
from calib.gap.workflow import Recordings, find_gap_in, write_gap
from control.dynamics.feedforward import torque_model
from control.model.arm import Arm
from control.model.description import load_arm
from control.model.maps import CorrectionMap
from tests.calib.gap.series.prescribed import arm_with_friction, log_of

pytestmark = pytest.mark.usefixtures("without_motion")
FRICTION = arm_with_friction()


def of_points(points) -> Recordings:
    return Recordings(points, None, (), (), ())


def of_log(log) -> Recordings:
    return Recordings(None, log, (), (), ())


def test_splines_and_the_controllers_table_are_the_same_curve() -> None:
    rng = np.random.default_rng(0)
    x, sign = rng.uniform(-2.5, 2.5, 50), rng.choice([-1.0, 1.0], 50)
    for over, lower, upper in (("angle_rad", -2.0, 2.0), ("motor_turn_rad", 0.0, 2.0 * np.pi)):
        size = rng.standard_normal(9)
        is_periodic = over == "motor_turn_rad"
        values = tuple(node_values(size, is_periodic).tolist())
        one = CorrectionMap(1, "torque_Nm", over, values, lower, upper, values)
        expected = (1.0 + sign) * (spline_columns(9, lower, upper, is_periodic, x) @ size)
        assert along(one, x, sign) == pytest.approx(expected, abs=1e-12)


@pytest.fixture(scope="module")
def eccentric():
    """An eccentricity that is not in the list: it has no name here."""
    points = case(11, (Hidden("encoder_eccentricity", 3, 0.005, 0.4),))
    return find_gap_in(ARM, of_points(points), without=("encoder_eccentricity",), with_maps=True)


def test_what_has_no_name_is_mapped_and_held_out_poses_are_at_the_noise(eccentric) -> None:
    (check,) = eccentric.finding.maps.checks
    floor = eccentric.finding.noise_floor["tip_m"]
    assert check.before > 1.25 * floor
    assert check.after < 1.05 * floor
    assert [one.joint for one in eccentric.finding.maps.maps] == [3]


def test_a_map_is_no_name(eccentric) -> None:
    assert {one.name.effect for one in eccentric.finding.effects} <= {"link_geometry", "base_frame"}
    assert eccentric.finding.unknown is not None
    assert eccentric.mapped.effects == ARM.effects


def test_the_written_file_moves_joints_as_the_map_says(eccentric, tmp_path: Path) -> None:
    write_gap(eccentric, ARM, of_points(eccentric.static.points), tmp_path / "out")
    written = load_arm(tmp_path / "out" / "arm.toml")
    found = json.loads((tmp_path / "out" / "gap.json").read_text())["maps"]
    assert [table["joint"] for table in found["tables"]] == [3]
    points = eccentric.static.points
    shift = known_corrections(written, points)[:, 2]
    true = 0.005 * np.sin(points.q_rad[:, 2] + 0.4)
    rest = true - shift  # but for a zero and a slope, which theta 3 and the lengths take
    line = np.column_stack([np.ones(len(rest)), points.q_rad[:, 2]])
    rest -= line @ np.linalg.lstsq(line, rest, rcond=None)[0]
    assert float(np.std(rest)) < 0.3e-3


KNOWN = CorrectionMap(1, "angle_rad", "angle_rad", (0.0, 0.001, 0.0, 0.0), -1.0, 1.0)


def test_where_nothing_is_hidden_no_map_is_written_and_those_of_the_file_are_left_aside() -> None:
    found = find_gap_in(dataclasses.replace(ARM, maps=(KNOWN,)), of_points(case(0)), with_maps=True)
    assert found.finding.maps.maps == ()
    assert found.mapped.maps == ()
    assert found.finding.gap_after < 1.1
    for said in ("none is written", "maps are not used"):
        assert any(said in sentence for sentence in found.warnings)


def drag(joint: int, q, speed, link):
    """Of oil: it grows with the square of the speed, and no list has it."""
    return 1.5 * speed * np.abs(speed) if joint == 1 else np.zeros_like(q)


def test_a_drag_without_a_name_is_unknown_and_says_where_and_is_mapped_over_the_speed_and_fed_forward() -> None:
    found = find_gap_in(FRICTION, of_log(log_of(FRICTION, drag)), with_maps=True)
    unknown = found.finding.unknown
    assert not found.finding.effects
    assert unknown is not None
    assert "joint 2" in unknown.where
    assert unknown.nearest == EffectName("viscous_friction", 2)
    assert 0.3 < unknown.explained < 0.99
    check = next(one for one in found.finding.maps.checks if one.joint == 2)
    assert check.after < 0.4 * check.before
    assert any((one.joint, one.over) == (2, "speed_rad_s") for one in found.finding.maps.maps)
    assert _needed(found.mapped) - _needed(FRICTION) == pytest.approx(1.5 * 2.0**2, rel=0.08)


def _needed(arm: Arm) -> float:
    """By joint 2 at 2 rad/s."""
    return torque_model(arm)((0.0, 0.2, 0.0), (0.0, 2.0, 0.0), (0.0,) * 3)[1]


def test_a_gain_is_believed_that_is_seen_in_most_pieces_or_is_large() -> None:
    rng = np.random.default_rng(3)
    pieces = np.repeat(np.arange(40), 5)
    noise = rng.standard_normal(200)
    assert not helps(noise, 0.999 * noise, pieces, CHECKED_sd)  # too little
    assert helps(noise, 0.95 * noise, pieces, CHECKED_sd)  # little, and everywhere
    few = noise.copy()
    few[:5] *= 8.0
    assert helps(few, noise, pieces, CHECKED_sd)  # much, in one piece
    mixed = noise * np.where(pieces % 2 == 0, 0.9, 1.03)
    assert not helps(noise, mixed, pieces, CHECKED_sd)  # a gain that comes and goes
