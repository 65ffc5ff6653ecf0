"""Poses of arms made without this project's kinematics: exact laws, laws that are only roughly right, several at once."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.gap.static.cases import ARM, NOISE_A, Design, Hidden, case, designed
from benchmarks.gap.static.rough_cases import case as rough_case
from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.parallel_axes import tilt_row, with_tilt_behind
from calib.gap.finding import EffectName, gap_content, with_given_numbers
from calib.gap.poses.answer import _files, pays
from calib.gap.poses.file import placed
from calib.gap.poses.find import _prepared, _searched, find
from calib.gap.poses.linear import along_joint
from calib.gap.poses.outcome import StaticGap
from calib.gap.posterior.decide import Estimated
from calib.gap.words import in_words
from calib.gap.workflow import find_gap
from calib.points.points import Points
from control.model.arm import Effect
from control.plain_text import silent
from tests.thirds import third_of


def names(found: StaticGap) -> set[EffectName]:
    return {effect.name for effect in found.finding.effects if effect.name.effect != "link_geometry"}


def value(found: StaticGap, effect: str, parameter: str) -> tuple[float, float]:
    return next(one for one in found.finding.effects if one.name.effect == effect).parameters[parameter]


def test_a_play_and_a_drift_are_named_together_with_a_time_constant_between_those_that_are_tried() -> None:
    found = find(ARM, case(31, (Hidden("backlash", 1, 0.006), Hidden("thermal_drift", 2, 0.006, 1150.0))))
    assert names(found) == {EffectName("backlash", 1), EffectName("thermal_drift", 2)}
    assert value(found, "backlash", "width_rad")[0] == pytest.approx(0.006, rel=0.05)
    assert found.finding.gap_after < 1.15
    assert found.finding.unknown is None
    time_s, sd_s = value(found, "thermal_drift", "time_constant_s")  # 948 s and 1393 s are tried
    assert time_s == pytest.approx(1150.0, rel=0.05)
    assert 0.0 < sd_s < 0.5 * time_s


def test_a_play_of_an_upright_axis_lies_where_the_joint_came_from_however_little_its_motor_holds() -> None:
    """The currents have the sign of the last motion in nine poses of ten: the others are their noise."""
    arm, points = designed(31, (Hidden("backlash", 1, 0.004),), Design(step=8, free=20))
    current_A = np.array(points.current_A)
    current_A[:, 0] = 0.15 * current_A[:, 0] + np.random.default_rng(31).normal(0.0, NOISE_A, len(points))
    found = find(arm, dataclasses.replace(points, current_A=current_A))
    assert names(found) == {EffectName("backlash", 1)}
    assert found.finding.unknown is None
    value_rad, sd_rad = value(found, "backlash", "width_rad")
    assert abs(value_rad - 0.004) < 1.96 * sd_rad < 0.0008


@pytest.mark.parametrize("width_rad", [0.0, 0.006])
def test_a_joint_that_stops_on_its_side_of_a_count_is_not_loose(width_rad: float) -> None:
    """A third of a count of 1.5 mrad too early from either side: repeats end in the same count and never show it."""
    hidden = (Hidden("backlash", 1, width_rad),) if width_rad else ()
    arm, points = designed(52, hidden, Design(step=8, free=20))
    drives = [dataclasses.replace(one, encoder_counts_per_rev=round(4096 / one.gear_ratio)) for one in arm.drives]
    step_rad = 2.0 * np.pi / np.array([one.counts_per_joint_turn for one in drives])
    read = step_rad * np.round(points.q_rad / step_rad - 0.35 * points.direction)
    coarse = dataclasses.replace(arm, drives=tuple(drives))
    found = find(coarse, dataclasses.replace(points, q_rad=read))
    assert names(found) == {EffectName(one.effect, one.joint) for one in hidden}
    assert found.finding.unknown is None
    if hidden:
        value_rad, sd_rad = value(found, "backlash", "width_rad")
        assert abs(value_rad - width_rad) < 2.0 * sd_rad < 0.5 * width_rad


def test_an_effect_that_the_file_knows_in_part_comes_out_as_the_total() -> None:
    known = dataclasses.replace(ARM, effects=(Effect("encoder_scale", 2, {"scale": 0.002}),))
    found = find(known, case(34, (Hidden("encoder_scale", 2, 0.006),)))
    assert names(found) == {EffectName("encoder_scale", 2)}
    total, sd = value(found, "encoder_scale", "scale")
    assert total == pytest.approx(0.006, abs=3.0 * sd)


def test_an_effect_that_the_file_has_right_is_not_missing() -> None:
    known = dataclasses.replace(ARM, effects=(Effect("encoder_scale", 2, {"scale": 0.006 / 1.006}),))
    assert names(find(known, case(34, (Hidden("encoder_scale", 2, 0.006),)))) == set()


@pytest.mark.parametrize(
    "wrong",
    third_of(
        [
            Effect("encoder_scale", 2, {"scale": 0.004}),
            Effect("joint_compliance", 2, {"stiffness_Nm_rad": 600.0}),
            Effect("link_flexure", 2, {"EI_Nm2": 400.0}),
        ]
    ),
    ids=lambda one: one.effect,
)
def test_an_effect_that_the_file_has_and_the_arm_has_not_is_a_total_of_none(wrong: Effect) -> None:
    arm = dataclasses.replace(ARM, effects=(wrong,))
    found = find(arm, case(34))
    (gone,) = (one for one in found.finding.effects if one.name.effect != "link_geometry")
    assert (gone.name.effect, gone.is_nothing) == (wrong.effect, True)
    assert found.finding.unknown is None
    assert found.finding.gap_after < 1.1
    assert any("Not there" in sentence for sentence in in_words(found.finding))
    assert found.file.effects == ()


TILTED, TILT_rad = with_tilt_behind(ARM, 2), 0.003


def with_tilted_axis(points: Points) -> Points:
    """The same poses of an arm whose axes 2 and 3 are not parallel."""
    dh = np.array(TILTED.dh)
    dh[tilt_row(TILTED, 2), 3] += TILT_rad
    off = ArmModel(TILTED).tips(dh, points.q_rad) - ArmModel(ARM).tips(ARM.dh, points.q_rad)
    return dataclasses.replace(points, tip_m=points.tip_m + off)


def assert_geometry(found: StaticGap) -> None:
    """The tilt is the arm's geometry, and hides nothing."""
    assert found.finding.unknown is None
    assert found.finding.gap_after < 1.15
    assert found.fitted_arm.links[tilt_row(TILTED, 2)].alpha_rad == pytest.approx(TILT_rad, rel=0.1)
    assert any("axes of joints 2 and 3 are not parallel" in sentence for sentence in found.warnings)


@pytest.mark.nightly  # a bending link beside such a tilt is asked below at each change
def test_axes_that_are_not_parallel_become_geometry_and_hide_no_spring() -> None:
    found = find(ARM, with_tilted_axis(case(36, (Hidden("joint_compliance", 3, 500.0),))))
    assert names(found) == {EffectName("joint_compliance", 3)}
    assert_geometry(found)


def test_axes_that_are_not_parallel_hide_no_bending_link_which_keeps_the_number_that_its_file_gave_it() -> None:
    """Its own row stands behind the one that was added for the tilt."""
    points = with_tilted_axis(case(16, (Hidden("link_flexure", 3, 150.0),)))
    outcome = find_gap(ARM, points, without=("joint_compliance",))
    assert outcome.static is not None
    assert_geometry(outcome.static)
    (bent,) = (one for one in outcome.static.file.effects if one.effect == "link_flexure")
    assert bent.joint == 4
    assert outcome.static.file.links[3].d_m == pytest.approx(ARM.links[2].d_m, abs=1e-3)
    said = "link_flexure on link 3 (link 4 of the new arm.toml)"
    (named,) = (one.name for one in outcome.finding.effects if one.name.effect == "link_flexure")
    assert (str(named), named) == (said, EffectName("link_flexure", 4))
    written = gap_content(outcome.finding)["effects"]
    assert isinstance(written, list)
    keys = ("effect", "joint", "given_joint")
    assert ("link_flexure", 4, 3) in [tuple(one.get(key) for key in keys) for one in written]
    labels = [name for name, _ in outcome.static.stages]
    assert said in labels
    sentences = (*in_words(outcome.finding), *labels, *outcome.warnings)
    assert not any("on link 4" in sentence.replace(said, "") for sentence in sentences)


def test_numbers_of_links_are_said_twice_only_where_they_changed() -> None:
    before = {3: 2, 4: 3}
    text = "link_inertia on link 4, link_flexure on link 1 or link_flexure on link 3: backlash on joint 3"
    assert with_given_numbers(text, before) == (
        "link_inertia on link 3 (link 4 of the new arm.toml), link_flexure on link 1 or link_flexure on link 2 (link 3 of the new"
        " arm.toml): backlash on joint 3"
    )
    assert with_given_numbers(with_given_numbers(text, before), before) == with_given_numbers(text, before)
    names = with_given_numbers((EffectName("link_flexure", 4), EffectName("backlash", 4)), before)
    assert [name.given_joint for name in names] == [3, None]


def test_what_is_named_says_its_probability_and_how_far_it_departs_from_its_law() -> None:
    found = find(ARM, case(35, (Hidden("belt_coupling", None, 0.012),)))
    belt = next(one for one in found.finding.effects if one.name.effect == "belt_coupling")
    assert belt.probability > 0.95
    assert belt.share > 0.9
    assert (belt.departure, belt.variable) == (pytest.approx(0.0, abs=0.05), "q2")


def test_an_arm_whose_drives_nobody_knows_shows_what_its_masses_allow() -> None:
    """Without [[drive]], or with placeholders in it: without currents, they say nothing that a pose shows."""
    _, points = designed(36, (Hidden("joint_compliance", 2, 500.0),), Design(step=6))
    points = dataclasses.replace(points, current_A=np.full_like(points.current_A, np.nan))
    bare = dataclasses.replace(ARM, drives=())
    placeholders = dataclasses.replace(
        ARM, drives=tuple(dataclasses.replace(d, torque_constant_Nm_A=0.5, current_limit_A=np.inf) for d in ARM.drives)
    )
    found = [find(arm, points) for arm in (bare, placeholders)]
    for one in found:
        assert EffectName("joint_compliance", 2) in names(one)
        assert value(one, "joint_compliance", "stiffness_Nm_rad")[0] == pytest.approx(500.0, rel=0.1)
    assert any("no [[drive]] of joints 1, 2, 3" in sentence for sentence in found[0].warnings)


def test_a_frame_that_nothing_ties_to_the_arm_is_placed_wherever_it_stands_and_nothing_is_named_for_it() -> None:
    arm, points = designed(37, (Hidden("base_frame", None, 0.004, 0.01),), Design(rig="planar", free=30, visits=4))
    turn = Rotation.from_rotvec((0.3, -2.0, 1.1))
    tracked = dataclasses.replace(points, tip_m=turn.apply(np.array(points.tip_m)) + np.array((3.0, -4.0, 1.0)))
    for seen in (points, tracked):
        found = find(arm, seen)
        assert names(found) == set()
        assert found.finding.unknown is None
        assert found.finding.gap_before < 100.0
        assert found.finding.gap_after < 1.2
        assert [one.effect for one in found.file.effects] == ["base_frame"]


def test_effects_at_once_do_not_make_the_points_another_arms() -> None:
    one = rough_case("many", 132_030)  # four effects of its own; the mirrored arm would leave a tenth less of them
    assert names(find(one.arm, one.points)) <= {EffectName(h.effect, h.joint) for h in one.hidden}


def test_a_name_whose_size_in_the_file_may_be_none_is_no_name() -> None:
    """A loose tool, which no effect is: the poses' own estimate of an eccentricity is 17 mrad, the file identifies 1.2."""
    one = rough_case("foreign", 990_015)
    found = find(one.arm, one.points)
    assert names(found) == set()
    assert found.finding.unknown is not None


def test_a_tip_near_the_axis_tells_no_turn() -> None:
    lever_m = np.array([[0.5, 0.0, 0.0], [0.0, 0.2, 0.0], [0.05, 0.0, 0.0], [0.0, 0.0, 0.0]])
    turn_rad = along_joint(lever_m, 1e-3 * lever_m + [0.0, 0.0, 1e-4])
    np.testing.assert_allclose(turn_rad, [1e-3, 1e-3, np.nan, np.nan])


def test_a_refitted_geometry_pays_only_beyond_the_noise_that_it_leaves() -> None:
    """20 parameters gain 60 variances of the floor: more than 20 +- 6 by chance, unless the noise is twice the floor's."""
    assert pays(1.2, 1.0, 300, 20)
    assert not pays(2.2, 2.0, 300, 20)
    assert not pays(1.1, 1.0, 300, 20)


def test_an_ambiguous_set_of_which_no_member_would_stand_is_left_without_a_name() -> None:
    """A loose tool looks like an eccentricity or a scale of joint 3: the file says of each that it may as well be none."""
    hidden = rough_case("foreign", 990015)
    found = find(hidden.arm, hidden.points).finding
    assert found.ambiguous == ()
    assert any("encoder_scale on joint 3 may as well be none, whichever it is" in one.where for one in found.remainder)


def test_no_name_stands_with_which_the_file_predicts_worse_than_the_given_arm() -> None:
    """Other recordings are sure of a scale that these poses do not have: the file would keep their value."""
    null, name = rough_case("null", 1_700_000), EffectName("encoder_scale", 2)
    linearised, decision = _searched(_prepared(null.arm, null.points, (), ()), silent)
    looked, value = linearised.looked, np.array([0.2])
    given = placed(looked.arm, looked.points, looked.parts.known)
    sure = Estimated({"scale": (0.2, 1e-4)}, 0.0, "", value, np.array([[1e-8]]), ())
    decided, files, reasons = _files(looked, given, dataclasses.replace(decision, names=(name,)), {name: sure}, {}, [name], {})
    assert decided.names == ()
    assert (name,) in decided.remainders
    assert "predicts other poses worse than the arm as it was given" in reasons[name]
    after, before = (fit.residuals().sizes(looked.parts.report)["tip_m"] for fit in (files[-1].fit, given))
    assert after < before
