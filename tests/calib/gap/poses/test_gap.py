"""Static poses: a hidden effect is found, nothing hidden is named nothing, what is not in the list is unknown."""

import numpy as np
import pytest

from benchmarks.gap.static.cases import ARM, DESIGNS, PARAMETER, Design, FRICTION_Nm, Hidden, case, designed, gravity_Nm
from calib.arm_problem.joint_effects import resting_points
from calib.arrays import rms
from calib.gap.finding import EffectName
from calib.gap.poses.find import find
from control.dynamics.dynamics import Dynamics
from tests.thirds import third_of

HIDDEN = [
    Hidden("backlash", 3, 0.004),
    Hidden("encoder_eccentricity", 3, 0.005, 0.4),
    Hidden("thermal_drift", 2, 0.004, 1500.0),
    Hidden("base_frame", None, 0.003, 0.01),
    Hidden("payload", None, 0.3),
]


def names(found) -> list[EffectName]:
    return [effect.name for effect in found.finding.effects if effect.name.effect != "link_geometry"]


def name_of(one: Hidden) -> EffectName:
    return EffectName(one.effect, one.joint)


@pytest.mark.parametrize("hidden", third_of(HIDDEN, 1), ids=lambda one: f"{one.effect}{one.joint or ''}")
def test_a_hidden_effect_is_found_and_its_gap_closes(hidden) -> None:
    found = find(ARM, case(11, (hidden,)))
    assert names(found) == [name_of(hidden)]
    value, _ = found.finding.effects[-1].parameters[PARAMETER[hidden.effect]]
    assert value == pytest.approx(hidden.value, rel=0.1)
    assert found.finding.gap_explained < 1.1
    # Where a pose does not tell the flank of a loose gear, the file has the middle of its play, as the controller does.
    share = 0.1 if hidden.effect == "backlash" else 1.1 / found.finding.gap_before
    assert found.finding.gap_after < share * found.finding.gap_before
    assert found.finding.unknown is None
    assert found.finding.ambiguous == ()


@pytest.mark.parametrize("seed", [0, pytest.param(32, marks=pytest.mark.nightly)])
def test_with_nothing_hidden_nothing_is_named_and_an_arm_with_that_geometry_stays_as_it_was_given(seed: int) -> None:
    """What was calibrated with these poses and others is not fitted again to the four fifths that decide."""
    points = case(seed)
    found = find(ARM, points)
    assert names(found) == []
    assert found.finding.ambiguous == ()
    assert found.finding.unknown is None
    assert found.finding.gap_after < 1.1
    again = find(found.file, points)
    assert again.finding.effects == ()
    assert again.file == again.arm
    assert again.finding.gap_after == again.finding.gap_before


@pytest.mark.parametrize("hidden", third_of([HIDDEN[0], HIDDEN[2], HIDDEN[4]]), ids=lambda one: f"{one.effect}{one.joint or ''}")
def test_an_effect_that_is_not_in_the_list_is_unknown_and_no_neighbour_is_named(hidden) -> None:
    found = find(ARM, case(11, (hidden,)), without=(hidden.effect,))
    assert names(found) == []
    assert found.finding.unknown is not None


@pytest.mark.parametrize(
    "said",
    third_of(
        [
            (Hidden("slip", 3, 0.006, 0.5), "joint 3: steps at"),
            (Hidden("camera skew", None, 0.006), "skewed"),
            (Hidden("registration", None, 0.002, 1.0), "setup roll"),
        ]
    ),
    ids=["slip", "camera skew", "registration"],
)
def test_what_no_law_describes_is_unknown_and_where_it_is_is_said(said) -> None:
    hidden, where = said
    found = find(ARM, case(13, (hidden,)))
    assert names(found) == []
    assert found.finding.unknown is not None
    assert where in found.finding.unknown.where


@pytest.mark.parametrize("seed", [16, pytest.param(17, marks=pytest.mark.nightly)])
def test_a_forearm_that_bends_is_never_called_a_soft_wrist(seed: int) -> None:
    """To most poses both are one; then they are an ambiguous set."""
    found = find(ARM, case(seed, (Hidden("link_flexure", 3, 150.0),)))
    assert EffectName("joint_compliance", 3) not in names(found)
    answers = {*names(found), *(name for names in found.finding.ambiguous for name in names)}
    assert EffectName("link_flexure", 3) in answers


def test_swapped_points_are_left_out_and_said_and_the_rest_is_answered() -> None:
    found = find(ARM, case(31, (Hidden("swapped points", None, 0.02, 0.02), Hidden("backlash", 1, 0.006))))
    assert names(found) == [EffectName("backlash", 1)]
    assert 2 <= found.looked.out.sum() <= 8
    assert any("are left out" in warning for warning in found.warnings)


@pytest.mark.parametrize("rig", ["planar", pytest.param("six", marks=pytest.mark.nightly)])
def test_another_arm_with_nothing_hidden_is_named_nothing(rig) -> None:
    arm, points = designed(17, (), Design(rig=rig, free=24 if rig == "six" else 45, visits=5))
    found = find(arm, points)
    assert names(found) == []
    assert found.finding.unknown is None


@pytest.mark.parametrize(
    "pair",
    third_of(
        [
            (Hidden("backlash", 1, 0.005), Hidden("joint_compliance", 2, 700.0)),
            (Hidden("link_flexure", 2, 100.0), Hidden("payload", None, 0.13)),  # which also bends the link
            (Hidden("belt_coupling", None, 0.012), Hidden("thermal_drift", 1, 0.005, 1200.0), Hidden("backlash", 2, 0.006)),
        ],
        2,
    ),
    ids=["backlash1+compliance2", "flexure2+payload", "coupling+drift1+backlash2"],
)
def test_two_or_three_effects_at_once_are_both_found(pair) -> None:
    found = find(ARM, case(14, pair))
    assert set(names(found)) == {name_of(one) for one in pair}
    values = {effect.name: effect.parameters for effect in found.finding.effects}
    for one in pair:
        assert values[name_of(one)][PARAMETER[one.effect]][0] == pytest.approx(one.value, rel=0.12)
    loose = [one.joint for one in pair if one.effect == "backlash"]
    unclear = np.any([resting_points(found.file, found.points).flank(joint) == 0.0 for joint in loose], axis=0) | np.zeros(
        len(found.points), dtype=bool
    )
    where_known = found.split.report & ~unclear
    assert where_known.sum() > 0.8 * found.split.report.sum()
    assert rms(found.stages[-1][1][where_known]) < 1.1 * found.floor.tip_m
    # all held-out poses count: elsewhere the file has the middle of the play
    if unclear[found.split.report].any():
        said = "\n".join(found.warnings)
        assert all(f"on which flank the loose gear of joint {joint} lies" in said for joint in loose)
        assert all(f"Record these poses with joint {joint} moved there in both directions" in said for joint in loose)
        assert 1.1 < found.finding.gap_after < 2.0
    else:
        assert found.finding.gap_after < 1.1


def test_a_level_board_from_one_side_cannot_tell_and_says_so() -> None:
    found = find(ARM, case(15, (Hidden("joint_compliance", 2, 780.0),), "level"))
    assert names(found) == []
    could = {one.name: one.is_nameable for one in found.finding.nameable}
    assert not could[EffectName("joint_compliance", 2)]
    assert not could[EffectName("backlash", 2)]
    assert "free poses away from the table" in str(found.finding.next_experiment)


def test_the_cases_gravity_is_that_of_the_model() -> None:
    q = np.array([0.3, -0.8, 0.5])
    dynamics = Dynamics(ARM, payload_kg=0.5)
    np.testing.assert_allclose(gravity_Nm(q, 0.5), dynamics.gravity(q), atol=1e-9)
    assert set(DESIGNS) == {"full", "thin", "level"}
    assert (FRICTION_Nm > 0).all()
