"""gap.json as docs/formats.md has it, held by a strict schema; what the model becomes where it knew a part already."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import msgspec
import pytest

from calib.gap.finding import (
    EffectName,
    GapFinding,
    MapCheck,
    MeasuredMaps,
    Nameable,
    NamedEffect,
    OpenQuestion,
    Remainder,
    Unknown,
    as_totals,
    updated_arm,
    write_gap_json,
)
from calib.gap.words import in_words, interval, parameters_text
from control.model.arm import Effect
from control.model.description import load_arm, save_arm
from control.model.maps import CorrectionMap


class Name(msgspec.Struct, forbid_unknown_fields=True):
    effect: str
    joint: int | None


class Value(msgspec.Struct, forbid_unknown_fields=True):
    value: float
    sd: float | None
    beside: float | None


class Departure(msgspec.Struct, forbid_unknown_fields=True):
    fraction: float
    variable: str


class Named(msgspec.Struct, forbid_unknown_fields=True):
    effect: str
    joint: int | None
    parameters: dict[str, Value]
    gap_after: float | None
    is_nothing: bool
    probability: float | None
    share: float | None
    law_departure: Departure | None
    evidence: dict[str, float | None]


class Refitted(msgspec.Struct, forbid_unknown_fields=True):
    effect: str
    joint: int | None
    parameters: dict[str, Value]


class Gap(msgspec.Struct, forbid_unknown_fields=True):
    before: float | None
    after: float | None
    explained: float | None
    before_si: dict[str, float | None]
    after_si: dict[str, float | None]


class Left(msgspec.Struct, forbid_unknown_fields=True):
    where: str
    nearest: Name | None
    explained: float | None


class Could(msgspec.Struct, forbid_unknown_fields=True):
    effect: str
    joint: int | None
    detectability: float | None
    confusable_with: list[Name]
    is_nameable: bool


class Rest(msgspec.Struct, forbid_unknown_fields=True):
    where: str
    share: float | None
    size_si: dict[str, float | None]


class Question(msgspec.Struct, forbid_unknown_fields=True):
    question: str
    next_experiment: str


class MapTable(msgspec.Struct, forbid_unknown_fields=True):
    joint: int
    corrects: str
    over: str
    largest: float
    largest_by_direction: float


class Checked(msgspec.Struct, forbid_unknown_fields=True):
    channel: str
    joint: int | None
    before_si: float
    after_si: float


class Maps(msgspec.Struct, forbid_unknown_fields=True):
    tables: list[MapTable]
    checked: list[Checked]


class GapJson(msgspec.Struct, forbid_unknown_fields=True):
    """The format gap/2."""

    format: str
    arm: str
    data: list[str]
    noise_floor: dict[str, float | None]
    gap: Gap
    effects: list[Named]
    refitted: list[Refitted]
    ambiguous: list[list[Name]]
    unknown: Left | None
    nameable: list[Could]
    next_experiment: str | None
    remainder: list[Rest]
    open_questions: list[Question]
    maps: Maps | None


def full() -> GapFinding:
    play, spring = EffectName("backlash", 1), EffectName("joint_compliance", 1)
    return GapFinding(
        "right",
        ("points.csv", "log.csv"),
        {"tip_m": 1.4e-4},
        12.4,
        float("nan"),
        {"tip_m": 2e-3},
        {"tip_m": float("inf")},
        (
            NamedEffect(play, {"width_rad": (0.005, float("nan"))}, 1.05, {"margin": 9.0}, 0.99, 0.8, 0.04, "load"),
            NamedEffect(EffectName("payload"), {"mass_kg": (0.1, 0.01)}, 1.02),
        ),
        ((play, spring),),
        Unknown("joint 2: in steps", spring, 0.3),
        (Nameable(play, 12.0, (spring,), needed_sd=6.0), Nameable(EffectName("payload"), 5.0, needed_sd=6.0)),
        "Record more.",
        remainder=(Remainder("joint 2: in steps", 0.1, {"tip_m": 3e-4}),),
        open_questions=(OpenQuestion("joint 2?", "Record more."),),
        refitted=(NamedEffect(EffectName("coulomb_friction", 2), {"torque_Nm": (0.71, 0.01)}, float("nan")),),
    )


@pytest.mark.parametrize(
    "found",
    [
        full(),
        dataclasses.replace(full(), effects=(), ambiguous=(), unknown=None, nameable=(), next_experiment=None),
        dataclasses.replace(full(), unknown=Unknown("the whole", None, 0.0)),
        dataclasses.replace(
            full(),
            maps=MeasuredMaps(
                (CorrectionMap(2, "angle_rad", "load_Nm", (0.0, 0.0, 0.001, 0.002), -5.0, 5.0),),
                (MapCheck("tip_m", None, 4e-4, 2e-4),),
            ),
        ),
    ],
)
def test_gap_json_has_all_keys_of_the_format_and_no_others(found: GapFinding, tmp_path: Path) -> None:
    write_gap_json(tmp_path / "gap.json", found)
    text = (tmp_path / "gap.json").read_text()
    read = msgspec.json.decode(text, type=GapJson)
    assert read.format == "gap/2"
    assert len(read.effects) == len(found.effects)
    assert "NaN" not in text
    assert "Infinity" not in text
    assert list(json.loads(text)) == list(GapJson.__struct_fields__)  # in the order of the format


def found_with(*effects: tuple[str, int | None, dict[str, float]]) -> GapFinding:
    named = tuple(
        NamedEffect(EffectName(name, joint), {key: (value, 0.0) for key, value in values.items()}, 1.0)
        for name, joint, values in effects
    )
    return dataclasses.replace(full(), effects=named, refitted=())


@pytest.mark.parametrize(
    ("effect", "joint", "known", "found", "sum_"),
    [
        ("backlash", 1, {"width_rad": 0.003}, {"width_rad": 0.002}, {"width_rad": 0.005}),
        ("coulomb_friction", 2, {"torque_Nm": 1.2}, {"torque_Nm": 0.4}, {"torque_Nm": 1.6}),
        ("belt_coupling", None, {"ratio": 0.01}, {"ratio": -0.004}, {"ratio": 0.006}),
        ("joint_compliance", 2, {"stiffness_Nm_rad": 600.0}, {"stiffness_Nm_rad": 300.0}, {"stiffness_Nm_rad": 200.0}),
        ("torque_constant", 1, {"scale": 0.95}, {"scale": 1.02}, {"scale": 0.97}),
        (
            "encoder_eccentricity",
            1,
            {"amplitude_rad": 0.003, "phase_rad": 0.0},
            {"amplitude_rad": 0.004, "phase_rad": 1.5707963267948966},
            {"amplitude_rad": 0.005, "phase_rad": 0.9272952180016122},
        ),
        (
            "stribeck_friction",
            3,
            {"torque_Nm": 0.5, "speed_rad_s": 0.1},
            {"torque_Nm": 0.7, "speed_rad_s": 0.05},
            {"torque_Nm": 0.7, "speed_rad_s": 0.05},
        ),
    ],
)
def test_a_change_beside_what_the_file_knows_is_said_and_written_as_the_total(
    effect, joint, known, found, sum_, tmp_path
) -> None:
    arm = dataclasses.replace(load_arm("right"), effects=(Effect(effect, joint, known),))
    total = as_totals(arm, found_with((effect, joint, found)))
    model = updated_arm(arm, total)
    assert {key: value for key, (value, _) in total.effects[0].parameters.items()} == pytest.approx(sum_)
    assert len(model.effects) == 1
    assert dict(model.effects[0].parameters) == pytest.approx(sum_)
    save_arm(model, tmp_path / "arm.toml")
    assert load_arm(tmp_path / "arm.toml").effects == model.effects


def test_an_effect_of_another_joint_is_added_beside_what_is_known() -> None:
    arm = dataclasses.replace(load_arm("right"), effects=(Effect("backlash", 1, {"width_rad": 0.003}),))
    model = updated_arm(arm, found_with(("backlash", 2, {"width_rad": 0.002}), ("link_geometry", None, {})))
    assert [(one.effect, one.joint) for one in model.effects] == [("backlash", 1), ("backlash", 2)]


def test_an_interval_is_wider_towards_the_other_estimate_and_ends_at_nought_where_nothing_is_below() -> None:
    """Viscous friction of a real joint: 2.0 in the file, 0.28 beside what has no name; two sd would hold nought."""
    rubbed = NamedEffect(
        EffectName("viscous_friction", 1),
        {"coefficient_Nm_s_rad": (2.0, math.hypot(0.2, 1.72))},
        1.0,
        beside={"coefficient_Nm_s_rad": 0.28},
    )
    assert interval(rubbed, "coefficient_Nm_s_rad") == pytest.approx((0.0, 2.0 + 1.96 * 0.2), rel=1e-3)
    assert parameters_text(rubbed) == "coefficient_Nm_s_rad = 2 (0 to 2.39)"
    firmer = dataclasses.replace(
        rubbed, parameters={"coefficient_Nm_s_rad": (2.0, math.hypot(0.2, 0.5))}, beside={"coefficient_Nm_s_rad": 2.5}
    )
    sides = 2.0 - 1.96 * 0.2, 2.0 + 1.96 * math.hypot(0.2, 0.5)
    assert interval(firmer, "coefficient_Nm_s_rad") == pytest.approx(sides, rel=1e-3)
    near = dataclasses.replace(rubbed, parameters={"coefficient_Nm_s_rad": (2.0, 0.2)}, beside={"coefficient_Nm_s_rad": 1.9})
    assert parameters_text(near) == "coefficient_Nm_s_rad = 2 +- 0.2"
    turned = dataclasses.replace(rubbed, parameters={"phase_rad": (-3.1, 0.1)}, beside={"phase_rad": 3.15})
    assert parameters_text(turned) == "phase_rad = -3.1 +- 0.1"


@pytest.mark.parametrize(
    ("effects", "holds_more"),
    [(("backlash", "thermal_drift"), False), (("joint_compliance",), True), (("backlash", "cogging"), True)],
)
def test_maps_are_offered_where_one_can_follow_what_departs(effects: tuple[str, ...], holds_more: bool) -> None:
    """A play on another flank and a drift with time are in no map."""
    named = tuple(NamedEffect(EffectName(effect, 1), {}, 2.0, departure=0.04) for effect in effects)
    sentences = in_words(dataclasses.replace(full(), effects=named, gap_after=2.0, gap_explained=1.0))
    (said,) = (sentence for sentence in sentences if "the laws alone" in sentence)
    assert ("--map" in said) == holds_more
