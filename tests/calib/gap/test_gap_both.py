"""Poses and time series of one arm: one finding of both, in which one resolves what the other leaves open."""

import dataclasses
import math
from functools import partial

import numpy as np
import pytest

from calib.gap.finding import (
    EffectName,
    GapFinding,
    MapCheck,
    MeasuredMaps,
    Nameable,
    NamedEffect,
    Unknown,
    gap_content,
    updated_arm,
)
from calib.gap.posterior.told import Told
from calib.gap.words import in_words
from calib.gap.workflow import brought_together, changed_between
from control.model.description import load_arm
from control.model.maps import CorrectionMap

PLAY, SPRING = EffectName("backlash", 1), EffectName("joint_compliance", 1)
DRAG, SCALE = EffectName("coulomb_friction", 2), EffectName("encoder_scale", 1)
GEOMETRY = EffectName("link_geometry")
seen = partial(Nameable, needed_sd=6.0)


def finding(channel: str, effects=(), nameable=(), unknown=None, gap=(2.0, 1.0), ambiguous=()) -> GapFinding:
    return GapFinding(
        "right",
        (f"{channel}.csv",),
        {channel: 1e-3},
        *gap,
        {channel: 2e-3},
        {channel: 1e-3},
        tuple(effects),
        unknown=unknown,
        nameable=tuple(nameable),
        ambiguous=tuple(ambiguous),
    )


def play(width: float, sd: float, gap_after: float = 1.0) -> NamedEffect:
    return NamedEffect(PLAY, {"width_rad": (width, sd)}, gap_after, {"margin": 9.0})


def spring(stiffness: float = 800.0) -> NamedEffect:
    return NamedEffect(SPRING, {"stiffness_Nm_rad": (stiffness, 5.0)}, 1.0)


def names(found: GapFinding) -> list[EffectName]:
    return [effect.name for effect in found.effects]


def test_one_level_alone_stays_as_it_is() -> None:
    poses = finding("tip_m", [play(0.005, 1e-4)])
    assert brought_together(poses, None) == poses
    assert brought_together(None, poses) == poses
    with pytest.raises(ValueError, match="at least one level"):
        brought_together(None, None)


def test_an_effect_of_both_is_listed_once_with_the_parameter_of_the_poses_and_both_in_its_evidence() -> None:
    both = brought_together(
        finding("tip_m", [play(0.0050, 1e-4)]),
        finding("current_A", [play(0.0051, 1e-3), NamedEffect(DRAG, {"torque_Nm": (0.5, 0.01)}, 1.0)]),
    )
    assert names(both) == [PLAY, DRAG]
    assert both.effects[0].parameters["width_rad"] == (0.0050, 1e-4)
    assert both.effects[0].evidence["width_rad by poses"] == 0.0050
    assert both.effects[0].evidence["width_rad by time series"] == 0.0051
    assert both.data == ("tip_m.csv", "current_A.csv")
    assert set(both.noise_floor) == {"tip_m", "current_A"}
    assert gap_content(both)["format"] == "gap/2"


def test_what_motion_alone_shows_of_an_effect_of_both_is_kept() -> None:
    moving = NamedEffect(SPRING, {"stiffness_Nm_rad": (790.0, 9.0), "damping_Nm_s_rad": (1.1, 0.1)}, 1.0)
    both = brought_together(finding("tip_m", [spring()]), finding("current_A", [moving]))
    assert both.effects[0].parameters == {"stiffness_Nm_rad": (800.0, 5.0), "damping_Nm_s_rad": (1.1, 0.1)}


def test_the_gap_of_both_is_their_root_mean_square() -> None:
    both = brought_together(finding("tip_m", gap=(3.0, 1.0)), finding("current_A", gap=(4.0, 1.0)))
    assert both.gap_before == pytest.approx(5.0 / math.sqrt(2.0))
    assert both.gap_after == pytest.approx(1.0)


def test_what_either_cannot_explain_stays_unknown_and_nameable_is_what_either_sees() -> None:
    unknown = Unknown("joint 2: steps at 10 s", None, 0.0)
    both = brought_together(
        finding("tip_m", nameable=[seen(PLAY, 3.0), seen(SPRING, 90.0, (PLAY,))]),
        finding("current_A", nameable=[seen(PLAY, 30.0), seen(SPRING, 20.0)], unknown=unknown),
    )
    assert both.unknown == Unknown("joint 2: steps at 10 s", None, 0.0)
    assert both.nameable == (seen(PLAY, 30.0), seen(SPRING, 20.0))  # told apart counts more than size


def told(width_rad: float, sd_rad: float) -> Told:
    information = np.array([[sd_rad**-2.0]])
    return Told({PLAY: np.array([0])}, information, information[0] * width_rad, np.array([0.003]))


@pytest.mark.parametrize(("width", "sd", "is_said"), [(0.0051, 1e-4, False), (0.0080, 1e-4, True), (0.0080, 2e-3, False)])
def test_a_size_that_the_two_cannot_share_is_doubted_and_the_name_is_kept(width, sd, is_said) -> None:
    """Three standard deviations are allowed."""
    both = brought_together(finding("tip_m", [play(0.0050, 1e-4)]), finding("current_A", [play(width, sd)]))
    assert names(both) == [PLAY]
    said = changed_between(both, told(0.0050, 1e-4), told(width, sd))
    assert len(said) == is_said
    assert not is_said or ("width_rad 0.00499 +- 0.0001" in said[0] and "was it changed" in said[0])


@pytest.mark.parametrize("is_swapped", [False, True])
def test_a_set_that_one_level_leaves_open_is_resolved_by_the_other(is_swapped: bool) -> None:
    unsure, sure = finding("tip_m", ambiguous=[(PLAY, SCALE)]), finding("current_A", [play(0.005, 1e-4)])
    both = brought_together(*((sure, unsure) if is_swapped else (unsure, sure)))
    assert names(both) == [PLAY]
    assert both.ambiguous == ()
    # what was left open was not in the model when its gap was looked at: it is null, not that of a poorer model
    content = gap_content(both)["gap"]
    assert content["after"] is None
    assert content["after_si"]["tip_m"] is None
    assert content["after_si"]["current_A"] == 1e-3
    assert "not evaluated" in " ".join(in_words(both))


@pytest.mark.parametrize("sure", [PLAY, EffectName("encoder_scale", 2)])
def test_the_map_of_a_set_stands_until_other_recordings_name_what_it_stands_for(sure: EffectName) -> None:
    table = CorrectionMap(1, "angle_rad", "angle_rad", (0.0, 1e-3, 2e-3, 1e-3), -1.0, 1.0)
    maps = MeasuredMaps((table,), (MapCheck("tip_m", None, 2e-3, 1e-3),))
    unsure = dataclasses.replace(finding("tip_m", ambiguous=[(PLAY, SCALE)]), maps=maps)
    named = NamedEffect(sure, {"width_rad" if sure == PLAY else "scale": (0.005, 1e-4)}, 1.0)
    both = brought_together(unsure, finding("current_A", [named]))
    assert both.maps == (None if sure == PLAY else maps)
    written = updated_arm(load_arm("right"), both)
    assert written.maps == (() if sure == PLAY else (table,))


def test_two_open_sets_become_what_they_share() -> None:
    both = brought_together(
        finding("tip_m", ambiguous=[(PLAY, SCALE, SPRING)]), finding("current_A", ambiguous=[(PLAY, SPRING, DRAG)])
    )
    assert both.ambiguous == ((PLAY, SPRING),)
    assert both.effects == ()


def test_sets_that_share_nothing_both_stay_open() -> None:
    both = brought_together(finding("tip_m", ambiguous=[(PLAY, SCALE)]), finding("current_A", ambiguous=[(SPRING, DRAG)]))
    assert both.ambiguous == ((PLAY, SCALE), (SPRING, DRAG))


def test_the_geometry_of_the_poses_stands() -> None:
    both = brought_together(
        finding("tip_m", [NamedEffect(GEOMETRY, {"link1_d_m": (0.001, 1e-5)}, 1.0)]),
        finding("current_A", [NamedEffect(GEOMETRY, {"link1_d_m": (0.009, 1e-6)}, 1.0)], [seen(GEOMETRY, 100.0)]),
    )
    assert names(both) == [GEOMETRY]
    assert both.effects[0].parameters["link1_d_m"] == (0.001, 1e-5)
