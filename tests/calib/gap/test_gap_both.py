"""Poses and time series of one arm: every name once, and what they disagree about is said."""

import math

import pytest

from calib.gap.both import disagreements, merged
from calib.gap.finding import EffectName, GapFinding, Nameable, NamedEffect, Unknown, gap_content

PLAY, DRAG = EffectName("backlash", 1), EffectName("coulomb_friction", 2)


def finding(channel: str, effects=(), nameable=(), unknown=None, gap=(2.0, 1.0)) -> GapFinding:
    return GapFinding(
        "right", (f"{channel}.csv",), {channel: 1e-3}, *gap, {channel: 2e-3}, {channel: 1e-3}, tuple(effects),
        unknown=unknown, nameable=tuple(nameable),
    )  # fmt: skip


def play(width: float, sd: float) -> NamedEffect:
    return NamedEffect(PLAY, {"width_rad": (width, sd)}, 1.0)


def test_an_effect_of_both_is_listed_once_with_the_parameter_that_is_known_better() -> None:
    both = merged(
        finding("tip_m", [play(0.0050, 1e-4)]),
        finding("current_A", [play(0.0051, 1e-3), NamedEffect(DRAG, {"torque_Nm": (0.5, 0.01)}, 1.0)]),
    )
    assert [effect.name for effect in both.effects] == [PLAY, DRAG]
    assert both.effects[0].parameters["width_rad"] == (0.0050, 1e-4)
    assert both.data == ("tip_m.csv", "current_A.csv")
    assert set(both.noise_floor) == {"tip_m", "current_A"}
    assert gap_content(both)["format"] == "gap/1"


def test_the_gap_of_both_is_their_root_mean_square() -> None:
    both = merged(finding("tip_m", gap=(3.0, 1.0)), finding("current_A", gap=(4.0, 1.0)))
    assert both.gap_before == pytest.approx(5.0 / math.sqrt(2.0))
    assert both.gap_after == pytest.approx(1.0)


def test_what_either_cannot_explain_stays_unknown_and_nameable_is_what_either_sees() -> None:
    unknown = Unknown("joint 2: steps at 10 s", None, 0.0)
    both = merged(
        finding("tip_m", nameable=[Nameable(PLAY, 3.0)]),
        finding("current_A", nameable=[Nameable(PLAY, 30.0)], unknown=unknown),
    )
    assert both.unknown == unknown
    assert both.nameable == (Nameable(PLAY, 30.0),)


@pytest.mark.parametrize(("width", "sd", "count"), [(0.0052, 1e-5, 0), (0.0080, 1e-5, 1), (0.0080, 2e-3, 0)])
def test_parameters_that_cannot_both_be_right_are_said(width, sd, count) -> None:
    """20 % or three standard deviations are allowed."""
    said = disagreements(finding("tip_m", [play(0.0050, 1e-5)]), finding("current_A", [play(width, sd)]))
    assert len(said) == count
