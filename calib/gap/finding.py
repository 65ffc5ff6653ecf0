"""What the gap workflow found, and gap.json (format gap/2 of the interchange formats)."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from control.files import write_whole
from control.model.effects import moved_joint, place_of
from control.model.maps import CorrectionMap

Parameters = Mapping[str, tuple[float, float]]  # by name: value and standard deviation

LINK_KEYS = ("d_m", "theta_rad", "L_m", "alpha_rad")  # of a link's deviations, in the order of its DH row
GEOMETRY = "link_geometry"  # the effect: the links' lengths and axes are others than the model's


@dataclass(frozen=True, slots=True)
class EffectName:
    """An effect on a joint or link (1-based; None where it has none), as docs/formats.md names it."""

    effect: str
    joint: int | None = None

    def __str__(self) -> str:
        """As `backlash on joint 2`."""
        place = place_of(self.effect)
        return self.effect if self.joint is None else f"{self.effect} on {place} {self.joint}"

    @property
    def acts_on(self) -> int | None:
        """The joint or link that it moves."""
        return moved_joint(self.effect, self.joint)

    def content(self) -> dict[str, object]:
        """For gap.json."""
        return {"effect": self.effect, "joint": self.joint}


@dataclass(frozen=True, slots=True)
class NamedEffect:
    """An effect that is added to the model: its parameters as totals, the gap with it, and why it was accepted.

    `probability` of it given the data, `share` of the excess over the noise that it explains, `departure` of the part from the
    textbook's law as a fraction of its size, over the law's own `variable`. NaN and "" where they were not determined.
    `is_nothing`: the arm's file has it and the data do not: its total is none, without parameters, and it is taken out.
    """

    name: EffectName
    parameters: Parameters
    gap_after: float
    evidence: Mapping[str, float] = field(default_factory=dict)
    probability: float = math.nan
    share: float = math.nan
    departure: float = math.nan
    variable: str = ""
    is_nothing: bool = False


@dataclass(frozen=True, slots=True)
class Remainder:
    """Something that is left without a name: where it shows, its share of the excess, its root mean square by channel (SI)."""

    where: str
    share: float
    size_si: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class OpenQuestion:
    """What this data leaves open, and the recording that would settle it."""

    question: str
    next_experiment: str


@dataclass(frozen=True, slots=True)
class MapCheck:
    """What is left on recordings that were not fitted, root mean square in SI, without and with the measured maps.

    `channel`: tip_m for maps of angles, torque_Nm of one joint (1-based) for maps of torques.
    """

    channel: str
    joint: int | None
    before: float
    after: float


@dataclass(frozen=True, slots=True)
class MeasuredMaps:
    """Maps that correct what has no name or departs from its law, and what they were checked on; none where none helps."""

    maps: tuple[CorrectionMap, ...] = ()
    checks: tuple[MapCheck, ...] = ()


@dataclass(frozen=True, slots=True)
class Nameable:
    """Whether this data could name an effect at all: detectability in standard deviations, and its confounders.

    Poses count those of an effect of usual size, time series those of the smallest size that is worth a name: `needed_sd` is what
    a name needs on the scale of this one, and no two scales are to be compared but by it.
    """

    name: EffectName
    detectability: float
    confusable_with: tuple[EffectName, ...] = ()
    needed_sd: float = field(kw_only=True)

    @property
    def is_nameable(self) -> bool:
        """Whether it would be named: it stands out, and nothing else looks the same."""
        return self.detectability >= self.needed_sd and not self.confusable_with


@dataclass(frozen=True, slots=True)
class Unknown:
    """Something is left that no effect explains: where it shows, the nearest proxy, the share that this explains."""

    where: str
    nearest: EffectName | None
    explained: float


@dataclass(frozen=True, slots=True)
class GapFinding:
    """All that gap.json holds. `noise_floor`, `before_si`, `after_si`: by channel, as tip_m, current_A, q_rad.

    `gap_before` and `gap_after`: root mean square over the noise floor, on recordings that were used for nothing else;
    `is_held_out` is False where there were none to spare and the gap is that of what was fitted. `maps`: of what sets share
    and, if asked for, of what is left; None where there are neither. `gap_after` is what arm.toml leaves, read back;
    `gap_explained` counts how each named part departs from its law, which no file holds.
    """

    arm: str
    data: tuple[str, ...]
    noise_floor: Mapping[str, float]
    gap_before: float
    gap_after: float
    before_si: Mapping[str, float]
    after_si: Mapping[str, float]
    effects: tuple[NamedEffect, ...] = ()
    ambiguous: tuple[tuple[EffectName, ...], ...] = ()
    unknown: Unknown | None = None
    nameable: tuple[Nameable, ...] = ()
    next_experiment: str | None = None
    is_held_out: bool = True
    remainder: tuple[Remainder, ...] = ()
    open_questions: tuple[OpenQuestion, ...] = ()
    maps: MeasuredMaps | None = None
    gap_explained: float = math.nan

    @property
    def unexplained(self) -> float:
        """The gap beside names and how their parts depart from their laws: what is a riddle, where it is above the noise."""
        return self.gap_explained if math.isfinite(self.gap_explained) else self.gap_after

    @property
    def judged_on(self) -> str:
        """The recordings on which the gap was evaluated, in words."""
        return "held-out recordings" if self.is_held_out else "the fitted recordings (none could be held out)"


def write_gap_json(path: Path, found: GapFinding) -> None:
    """Write gap.json; an unknown number is null."""
    write_whole(path, json.dumps(gap_content(found), indent=2, allow_nan=False) + "\n")


def gap_content(found: GapFinding) -> dict[str, object]:
    """What stands in gap.json."""
    return {
        "format": "gap/2",
        "arm": found.arm,
        "data": list(found.data),
        "noise_floor": _numbers(found.noise_floor),
        "gap": {
            "before": _number(found.gap_before),
            "after": _number(found.gap_after),
            "explained": _number(found.gap_explained),
            "before_si": _numbers(found.before_si),
            "after_si": _numbers(found.after_si),
        },
        "effects": [_named(effect) for effect in found.effects],
        "ambiguous": [[name.content() for name in names] for names in found.ambiguous],
        "unknown": None if found.unknown is None else _unknown(found.unknown),
        "nameable": [
            {
                **one.name.content(),
                "detectability": _number(one.detectability),
                "confusable_with": [name.content() for name in one.confusable_with],
                "is_nameable": one.is_nameable,
            }
            for one in found.nameable
        ],
        "next_experiment": found.next_experiment,
        "remainder": [
            {"where": one.where, "share": _number(one.share), "size_si": _numbers(one.size_si)}
            for one in found.remainder
        ],
        "open_questions": [
            {"question": one.question, "next_experiment": one.next_experiment} for one in found.open_questions
        ],
        "maps": None if found.maps is None else _maps(found.maps),
    }


def _named(effect: NamedEffect) -> dict[str, object]:
    return {
        **effect.name.content(),
        "parameters": {
            name: {"value": value, "sd": _number(sd)} for name, (value, sd) in effect.parameters.items()
        },
        "is_nothing": effect.is_nothing,
        "gap_after": _number(effect.gap_after),
        "probability": _number(effect.probability),
        "share": _number(effect.share),
        "law_departure": None
        if math.isnan(effect.departure)
        else {"fraction": effect.departure, "variable": effect.variable},
        "evidence": _numbers(effect.evidence),
    }


def _maps(found: MeasuredMaps) -> dict[str, object]:
    return {
        "tables": [
            {
                "joint": one.joint,
                "corrects": one.corrects,
                "over": one.over,
                "largest": max(map(abs, one.values)),
                "largest_by_direction": max(map(abs, one.by_direction), default=0.0),
            }
            for one in found.maps
        ],
        "checked": [
            {"channel": one.channel, "joint": one.joint, "before_si": one.before, "after_si": one.after}
            for one in found.checks
        ],
    }


def _unknown(unknown: Unknown) -> dict[str, object]:
    nearest = None if unknown.nearest is None else unknown.nearest.content()
    return {"where": unknown.where, "nearest": nearest, "explained": _number(unknown.explained)}


def _numbers(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: _number(value) for name, value in values.items()}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
