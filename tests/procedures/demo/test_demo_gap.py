"""What `armwright demo gap` hides, and what makes no sense to ask of it. The whole circle is `make demo-gap`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import msgspec
import pytest

from calib.errors import CalibrationError
from calib.gap.finding import EffectName
from console.main import main
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Effect
from control.model.description import load_arm
from control.model.effects import EFFECTS
from hil_mocks.assembly import build_plant
from hil_mocks.scenario import Scenario, parse_scenario
from procedures.demo.gap import DRAWN, SIZES, Hidden, beyond_known, drawn, programme_of, with_known_friction

RIGHT = load_arm("right")


def at_rest(scenario: Scenario) -> Scenario:
    """At a pose inside the limits."""
    return msgspec.structs.replace(scenario, start=msgspec.structs.replace(scenario.start, q_rad=(0.0, 0.1, 0.2)))


@pytest.mark.parametrize("effect", sorted(SIZES))
def test_every_effect_that_can_be_hidden_is_one_of_the_list_and_has_physics(effect: str) -> None:
    assert effect in EFFECTS
    hidden = drawn(3, effect, None)
    scenario = parse_scenario(hidden.as_scenario("gap", 3), "drawn")
    assert [(one.effect, one.joint) for one in scenario.effect] == [(effect, hidden.joint or 0)]
    build_plant(RIGHT, at_rest(scenario))


def test_a_seed_hides_the_same_every_time_and_seeds_hide_different_things() -> None:
    assert drawn(7, None, None) == drawn(7, None, None)
    many = [drawn(seed, None, None) for seed in range(40)]
    assert {one.effect for one in many} == set(DRAWN)
    assert len({str(one) for one in many}) == 40


def test_what_is_hidden_of_an_effect_that_the_file_knows_comes_on_top() -> None:
    arm = with_known_friction(RIGHT)
    assert {(e.effect, e.joint) for e in arm.effects} == {
        (name, j) for name in ("coulomb_friction", "viscous_friction") for j in (1, 2, 3)
    }
    hidden = Hidden("coulomb_friction", 2, {"torque_Nm": 0.5})
    assert beyond_known(hidden, arm).parameters["torque_Nm"] == pytest.approx(1.7)
    assert beyond_known(Hidden("backlash", 2, {"width_rad": 0.5}), arm).parameters == {"width_rad": 0.5}
    assert with_known_friction(arm).effects == arm.effects
    some = dataclasses.replace(RIGHT, effects=(Effect("coulomb_friction", 1, {"torque_Nm": 9.0}),))
    assert with_known_friction(some).effects[0].parameters["torque_Nm"] == 9.0


def test_places_are_within_reach_inside_the_limits_and_above_the_floor() -> None:
    programme = programme_of(RIGHT)
    assert len(programme.places) == 10
    assert len(programme.ways) == 2
    assert all(place.tip_m[2] > RIGHT.limits.floor_z_m for place in programme.places)
    assert ForwardKinematics(RIGHT).tip(0.0, 0.0, 0.0)[2] > 0.0


@pytest.mark.parametrize(
    ("effect", "joint", "says"),
    [
        ("ghost", None, 'got "ghost"'),
        ("backlash", 4, "expected joint 1 or 2 or 3 for backlash, got 4"),
        ("joint_compliance", 1, "expected joint 2 or 3 for joint_compliance, got 1"),
        ("belt_coupling", 1, r"no joint \(it acts on the whole arm\)"),
    ],
)
def test_what_cannot_be_hidden_is_said(effect: str, joint: int | None, says: str) -> None:
    with pytest.raises(CalibrationError, match=says):
        drawn(1, effect, joint)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["gap", "--effect", "ghost"], 'got "ghost"'),
        (["gap", "--scenario", "paper"], "--scenario is not for `armwright demo gap`"),
        (["gap", "--realtime"], "--realtime is not for `armwright demo gap`"),
        (["job", "--effect", "backlash"], "--effect is only for `armwright demo gap`"),
        (["paper", "--joint", "1"], "--joint is only for `armwright demo gap`"),
    ],
)
def test_options_that_do_not_go_together_are_one_clear_error(
    arguments: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["demo", *arguments, "--out", str(tmp_path / "d")]) == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "d").exists()


def test_names_are_written_as_in_findings() -> None:
    assert str(Hidden("backlash", 2, {"width_rad": 0.005})).startswith(str(EffectName("backlash", 2)))
    assert str(Hidden("link_inertia", 2, {"mass_kg": 0.2})).startswith(str(EffectName("link_inertia", 2)))
    assert str(Hidden("payload", None, {"mass_kg": 0.2})) == "payload (mass_kg = 0.2)"
