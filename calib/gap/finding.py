"""What the gap workflow found, and gap.json (format gap/2 of the interchange formats)."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from calib.arrays import Array
from control.files import write_whole
from control.model.arm import Arm, Effect
from control.model.effects import EFFECTS, moved_joint, place_of, total
from control.model.maps import CorrectionMap

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Said = TypeVar("Said")
Parameters = Mapping[str, tuple[float, float]]  # by name: value and standard deviation

LINK_KEYS = ("d_m", "theta_rad", "L_m", "alpha_rad")  # of a link's deviations, in the order of its DH row
GEOMETRY = "link_geometry"  # the effect: the links' lengths and axes are others than the model's


@dataclass(frozen=True, slots=True)
class EffectName:
    """An effect on a joint or link (1-based; None where it has none), as docs/formats.md names it.

    `given_joint`: a link's number in the file that was given, where the new one has rows more before it.
    """

    effect: str
    joint: int | None = None
    given_joint: int | None = field(default=None, compare=False)

    def __str__(self) -> str:
        """As `backlash on joint 2`; of a belt, whose file has no joint, the one that it moves."""
        place, joint = place_of(self.effect), self.acts_on
        if self.given_joint is not None:
            return f"{self.effect} on {place} {self.given_joint} ({place} {self.joint} of the new arm.toml)"
        return self.effect if joint is None else f"{self.effect} on {place} {joint}"

    @property
    def acts_on(self) -> int | None:
        """The joint or link that it moves."""
        return moved_joint(self.effect, self.joint)


@dataclass(frozen=True, slots=True)
class NamedEffect:
    """An effect that is added to the model: its parameters as totals, the gap with it, and why it was accepted.

    `probability` of it given the data, `share` of the excess over the noise that it explains, `departure` of the part from the
    textbook's law as a fraction of its size, over the law's own `variable`. NaN and "" where they were not determined.
    `is_nothing`: the arm's file has it and the data do not: its total is none, without parameters, and it is taken out.
    `beside`: parameters as they are beside all that has no name, where that is another estimate.
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
    beside: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DrawnLaw:
    """What the data show of an effect at k poses or rows, its law, and the law with its departure.

    `at` (k,) with the label `variable`; data, law, whole (k,) in `unit`: mrad of the joint, mm of the tip, mA of a motor.
    """

    name: EffectName
    variable: str
    unit: str
    at: Array
    data: Array
    law: Array
    whole: Array


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
    and, if asked for, of what is left; None where there are neither. `refitted`: what the arm's file has beside the names, where
    it was identified anew with them, as totals: values, no findings. `gap_after` is what arm.toml leaves, read back;
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
    refitted: tuple[NamedEffect, ...] = ()

    @property
    def unexplained(self) -> float:
        """The gap beside names and how their parts depart from their laws: what is a riddle, where it is above the noise."""
        return self.gap_explained if math.isfinite(self.gap_explained) else self.gap_after

    @property
    def judged_on(self) -> str:
        """The recordings on which the gap was evaluated, in words."""
        return "held-out recordings" if self.is_held_out else "the fitted recordings (none could be held out)"


def with_given_numbers(statements: Said, before: Mapping[int, int]) -> Said:
    """What is said of links by their numbers in the new file, said by those of the given one, too: names, and words with names.

    `before`: of every link that has another number now, its number in the given file.
    """

    def both(mention: re.Match[str]) -> str:
        name, number = mention[1], int(mention[2])
        is_of_link = name in EFFECTS and place_of(name) == "link" and number in before
        return str(EffectName(name, number, before[number])) if is_of_link else mention[0]

    def renamed(value: object) -> object:
        match value:
            case EffectName(joint=int(number)) if place_of(value.effect) == "link":
                return replace(value, given_joint=before.get(number))
            case str():
                return re.sub(r"\b(\w+) on link (\d+)\b(?! \(link )", both, value)
            case tuple():
                return tuple(map(renamed, value))
            case Remainder() | OpenQuestion() | NamedEffect() | Nameable() | Unknown() | GapFinding():
                members = {entry.name: renamed(getattr(value, entry.name)) for entry in fields(value)}
                return replace(cast(Any, value), **members)
            case _:
                return value

    return cast(Said, renamed(statements))


def write_gap_json(path: Path, finding: GapFinding) -> None:
    """Write gap.json; an unknown number is null."""
    write_whole(path, json.dumps(gap_content(finding), indent=2, allow_nan=False) + "\n")


def _with_sd(effect: NamedEffect) -> dict[str, object]:
    return {key: {"value": value, "sd": sd, "beside": effect.beside.get(key)} for key, (value, sd) in effect.parameters.items()}


def gap_content(finding: GapFinding) -> dict[str, object]:
    """What stands in gap.json."""
    whole = {
        "format": "gap/2",
        "arm": finding.arm,
        "data": finding.data,
        "noise_floor": finding.noise_floor,
        "gap": {
            "before": finding.gap_before,
            "after": finding.gap_after,
            "explained": finding.gap_explained,
            "before_si": finding.before_si,
            "after_si": finding.after_si,
        },
        "effects": [
            {
                **_fields(part.name),
                "parameters": _with_sd(part),
                "is_nothing": part.is_nothing,
                "gap_after": part.gap_after,
                "probability": part.probability,
                "share": part.share,
                "law_departure": None if math.isnan(part.departure) else {"fraction": part.departure, "variable": part.variable},
                "evidence": part.evidence,
            }
            for part in finding.effects
        ],
        "refitted": [{**_fields(part.name), "parameters": _with_sd(part)} for part in finding.refitted],
        "ambiguous": finding.ambiguous,
        "unknown": finding.unknown,
        "nameable": [
            {
                **_fields(nameable.name),
                "detectability": nameable.detectability,
                "confusable_with": nameable.confusable_with,
                "is_nameable": nameable.is_nameable,
            }
            for nameable in finding.nameable
        ],
        "next_experiment": finding.next_experiment,
        "remainder": finding.remainder,
        "open_questions": finding.open_questions,
        "maps": finding.maps
        and {
            "tables": [_table(correction) for correction in finding.maps.maps],
            "checked": [
                {"channel": check.channel, "joint": check.joint, "before_si": check.before, "after_si": check.after}
                for check in finding.maps.checks
            ],
        },
    }
    return {key: _plain(value) for key, value in whole.items()}


def _table(correction: CorrectionMap) -> dict[str, object]:
    largest, directed = (max(map(abs, values), default=0.0) for values in (correction.values, correction.by_direction))
    where = {"joint": correction.joint, "corrects": correction.corrects, "over": correction.over}
    return {**where, "largest": largest, "largest_by_direction": directed}


def _fields(record: DataclassInstance) -> dict[str, object]:
    values = {entry.name: getattr(record, entry.name) for entry in fields(record)}
    return {name: value for name, value in values.items() if name != "given_joint" or value is not None}


def _plain(value: object) -> object:
    """For JSON: records by the names of their fields, and null for a number that is not known."""
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(_fields(value))
    if isinstance(value, Mapping):
        return {key: _plain(element) for key, element in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(element) for element in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


# The named effects added to the model: what arm.toml becomes.


def updated_arm(arm: Arm, finding: GapFinding) -> Arm:
    """The arm with what was named, which is a total, what was identified anew, and the maps that were found, in place of what its
    file has.

    An effect whose total is none is taken out, and so are maps that were measured beside other effects.
    """
    effects = [effect for effect in finding.effects if effect.name.effect != GEOMETRY]
    named = [effect_of(effect.name, effect.parameters) for effect in effects if not effect.is_nothing]
    removed = {(effect.name.effect, effect.name.joint) for effect in effects if effect.is_nothing}
    remaining = tuple(effect for effect in arm.effects if (effect.effect, effect.joint) not in removed)
    maps = () if finding.maps is None else finding.maps.maps
    refitted = [effect_of(effect.name, effect.parameters) for effect in finding.refitted]
    return with_totals(replace(arm, effects=remaining, maps=maps), [*refitted, *named])


def with_geometry(arm: Arm, finding: GapFinding) -> Arm:
    """The arm with the deviations of its links that time series showed."""
    dh = np.array(arm.dh)
    for effect in finding.effects:
        for name, (value, _) in effect.parameters.items() if effect.name.effect == GEOMETRY else ():
            link, kind = name.removeprefix("link").split("_", 1)
            dh[int(link) - 1, LINK_KEYS.index(kind)] += value
    return arm.with_dh(dh)


def effect_of(name: EffectName, parameters: Mapping[str, tuple[float, float]]) -> Effect:
    """As the arm's file has it."""
    return Effect(name.effect, name.joint, values_alone(parameters))


def values_alone(parameters: Parameters) -> dict[str, float]:
    """Parameters without their standard deviations."""
    return {key: value for key, (value, _) in parameters.items()}


def with_totals(arm: Arm, totals: Sequence[Effect]) -> Arm:
    """The arm with these effects in place of its own of the same names."""
    known = {(effect.effect, effect.joint): effect for effect in arm.effects}
    for effect in totals:
        before = known.get((effect.effect, effect.joint))
        parameters = effect.parameters if before is None else {**before.parameters, **effect.parameters}
        known[effect.effect, effect.joint] = Effect(effect.effect, effect.joint, parameters)
    return replace(arm, effects=tuple(known.values()))


def as_totals(arm: Arm, finding: GapFinding) -> GapFinding:
    """A finding of changes beside what the arm's file has, as one of totals; a total that no part can have is none."""
    known = {EffectName(effect.effect, effect.joint): effect.parameters for effect in arm.effects}

    def total_of(named: NamedEffect) -> NamedEffect:
        if named.name in known:
            effect, before = named.name.effect, known[named.name]
            beside = total(effect, before, named.beside) if named.beside else {}
            named = replace(named, parameters=as_total(effect, before, named.parameters), beside=beside)
        return named if is_possible(named.name.effect, named.parameters) else replace(named, parameters={}, is_nothing=True)

    refitted = tuple(effect for effect in map(total_of, finding.refitted) if not effect.is_nothing)
    return replace(finding, effects=tuple(map(total_of, finding.effects)), refitted=refitted)


def is_possible(effect: str, parameters: Parameters) -> bool:
    """Whether a file may have them: no friction is below nought."""
    kind = EFFECTS[effect]
    values = values_alone(parameters)
    return not any(values.get(name, 1.0) <= 0.0 for name in kind.positive) and not any(
        values.get(name, 0.0) < 0.0 for name in kind.not_negative
    )


def as_total(effect: str, known: Mapping[str, float], changes: Parameters) -> Parameters:
    """Both as one effect of the same kind, with the standard deviations of what was found."""
    values = total(effect, known, values_alone(changes))
    return {name: (value, changes.get(name, (value, 0.0))[1]) for name, value in values.items()}
