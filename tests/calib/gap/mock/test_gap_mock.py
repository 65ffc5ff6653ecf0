"""What is hidden in the mock arm's physics, which share nothing with the model's effects, is named, and nothing else is.

The poses of recorded/ are those of `benchmarks.gap.mock.static.static_case`, seeds 30 (nothing) and 31 (a play of 4 mrad in
joint 2), and those that `armwright demo gap --effect joint_compliance --seed 3` records (341 N m/rad in joint 2); the runs
are made here, as they would be large.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.gap.matrix import GEOMETRY
from benchmarks.gap.mock.cases import arm_with_friction, entry, joints_of
from benchmarks.gap.mock.motion import CURRENT_NOISE_A, motion_case
from benchmarks.gap.mock.rig import MockRig, eased, effects_with
from calib.arrays import Array
from calib.gap.finding import EffectName, GapFinding
from calib.gap.log import Log
from calib.gap.poses.find import find as find_in_poses
from calib.gap.series.find import find as find_in_motion
from calib.points.points import Points, read_points
from control.model.arm import Arm
from control.model.description import load_arm
from control.model.effects import EFFECTS
from hil_mocks.plant.effects import EffectEntry

pytestmark = pytest.mark.usefixtures("without_motion")

ARM = load_arm("right")
RECORDED = Path(__file__).parent / "recorded"
PLAY2 = EffectName("backlash", 2)
LOAD2 = EffectName("load_friction", 2)


def names(found: GapFinding) -> list[EffectName]:
    """What was named beside the geometry, which is hidden in all poses."""
    return [effect.name for effect in found.effects if effect.name.effect != GEOMETRY]


def poses(name: str) -> Points:
    return read_points(RECORDED / f"{name}.csv.gz", ARM.joint_count)[0]


@pytest.fixture(scope="module")
def known() -> Arm:
    return arm_with_friction(ARM, 32)


@pytest.fixture(scope="module")
def log(known: Arm) -> Log:
    """Runs of 2 s: enough for friction that grows with load."""
    return motion_case(known, (entry("load_friction", 2, 0.15, np.random.default_rng(32)),), 32, seconds=2.0)


def test_play_in_poses_of_the_mock_arm_is_named_with_its_width() -> None:
    found = find_in_poses(ARM, poses("backlash2")).finding
    assert names(found) == [PLAY2]
    assert found.effects[-1].parameters["width_rad"][0] == pytest.approx(0.004, rel=0.1)
    assert found.unknown is None
    # 26 poses report: a root mean square of 78 values scatters by 8 %.
    assert found.gap_after == pytest.approx(1.0, abs=0.2)


def test_a_soft_spring_is_named_although_friction_winds_it_up_in_some_poses() -> None:
    """In a few poses the link came to rest otherwise than by its last motion."""
    found = find_in_poses(ARM, poses("soft_spring2")).finding
    assert names(found) == [EffectName("joint_compliance", 2)]
    assert found.effects[-1].parameters["stiffness_Nm_rad"][0] == pytest.approx(341.1, rel=0.02)
    assert found.gap_explained < 0.03 * found.gap_before
    assert found.gap_after < 0.16 * found.gap_before  # no file says what friction winds up behind a gear
    assert found.unknown is None


def test_nothing_is_named_in_poses_of_a_crooked_but_perfect_mock_arm() -> None:
    found = find_in_poses(ARM, poses("nothing")).finding
    assert names(found) == []
    assert found.unknown is None
    assert not found.ambiguous
    assert found.gap_after == pytest.approx(1.0, abs=0.2)


def test_play_that_is_taken_off_the_list_is_unknown_and_where_it_is_is_said() -> None:
    found = find_in_poses(ARM, poses("backlash2"), without=("backlash",)).finding
    assert names(found) == []
    assert found.unknown is not None
    assert "joint 2" in found.unknown.where


def test_friction_under_load_in_runs_of_the_mock_arm_is_named_with_its_fraction(known: Arm, log: Log) -> None:
    found = find_in_motion(known, log)
    assert names(found) == [LOAD2]
    assert found.effects[0].parameters["fraction"][0] == pytest.approx(0.15, rel=0.1)
    assert found.unknown is None
    assert found.gap_after < 1.3 < found.gap_before


@pytest.mark.nightly  # of prescribed motions, and of the command, the same is asked at each change
def test_friction_under_load_that_is_taken_off_the_list_is_unknown(known: Arm, log: Log) -> None:
    found = find_in_motion(known, log, candidates=[name for name in EFFECTS if name != "load_friction"])
    assert names(found) == []
    assert found.unknown is not None
    assert "joint 2" in found.unknown.where


def test_the_runs_stay_within_the_joint_limits(log: Log) -> None:
    """An end stop that is hit is a hidden effect that truth.json does not know of."""
    lower, upper = np.array(ARM.limits_rad).T
    for run in log.runs:
        assert (run.q_rad > lower).all()
        assert (run.q_rad < upper).all()
        assert np.abs(run.current_A).max() < 0.9 * ARM.drives[0].current_limit_A


def test_repeats_differ_by_their_sensors_only(log: Log) -> None:
    pairs = [group for group in log.repeats() if len(group) == 2]
    assert len(pairs) == 2
    for one, other in pairs:
        np.testing.assert_array_equal(log.runs[one].q_rad, log.runs[other].q_rad)
        apart = log.runs[one].current_A - log.runs[other].current_A
        assert apart.std() == pytest.approx(CURRENT_NOISE_A * np.sqrt(2.0), rel=0.05)


def standing(arm: Arm, hidden: tuple[EffectEntry, ...], payload_kg: float) -> tuple[Array, Array]:
    """Angles and currents after a short move."""
    rig = MockRig(arm, effects_with(arm, hidden), (0.0, -0.5, 0.2), payload_kg, integral=False)
    rig.follow(eased(np.array([0.0, -0.5, 0.2]), np.array([0.1, -0.45, 0.25]), 0.4))
    reading = rig.reading()
    return np.array(reading.q_rad), np.array(reading.current_A)


def test_hidden_friction_and_payload_come_on_top_of_what_is_known(known: Arm) -> None:
    more = effects_with(known, (EffectEntry("coulomb_friction", 2, {"torque_Nm": 0.3}),))
    file = next(e for e in known.effects if (e.effect, e.joint) == ("coulomb_friction", 2))
    assert more.joints[1].coulomb_Nm == pytest.approx(file.parameters["torque_Nm"] + 0.3)
    _, light = standing(ARM, (), 0.5)
    _, heavy = standing(ARM, (EffectEntry("payload", 0, {"mass_kg": 0.2}),), 0.5)
    assert abs(heavy[1]) > abs(light[1]) + 0.1


def test_every_effect_of_the_cases_is_one_of_the_list_and_has_a_joint_to_be_on() -> None:
    from benchmarks.gap.mock.cases import DYNAMIC, STATIC

    for level, table in (("static", STATIC), ("dynamic", DYNAMIC)):
        for effect in table:
            assert effect in EFFECTS
            assert joints_of(effect, level, ARM)  # type: ignore[arg-type]
    assert joints_of("joint_compliance", "static", ARM) == (2, 3)  # joint 1 stands upright: gravity does not bend it
