"""From a log to what is missing in the model by one posterior: names, sets, remainders, and the gap on runs kept apart."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.dynamic.find import (
    DynamicOutcome,
    _advice,
    _doubts,
    _floors,
    _in_rad,
    _in_si,
    _rising,
    gap,
)
from calib.gap.dynamic.plausible import plausible
from calib.gap.dynamic.rows import Rows
from calib.gap.dynamic.sizes import is_worth_a_name
from calib.gap.dynamic.split import split
from calib.gap.finding import EffectName, GapFinding, Nameable, NamedEffect, Unknown
from calib.gap.log import Log
from calib.gap.posterior.constants import DEPARTURES, FLOOR_DOUBT
from calib.gap.posterior.evidence import Evidence
from calib.gap.posterior.nameable import nameable
from calib.gap.posterior.term import Block, Key
from calib.gap.series.blocks import CAMERA
from calib.gap.series.constants import REMAINS, SILENT_MOST, SURE_sd
from calib.gap.series.effects import usual
from calib.gap.series.linear import only
from calib.gap.series.look import Look, left, looked
from calib.gap.series.scene import Scene
from calib.gap.series.term import SeriesTerm
from calib.gap.signals import forms
from calib.gap.signals.motion import motion_gaps
from calib.gap.signals.physics import Physics
from calib.gap.signals.recording import Recording, prepare
from calib.gap.signals.terms import Term as Law
from control.model.arm import Arm
from control.progress import Advance, silent

LAW_MOST = 2.0 * max(
    DEPARTURES
)  # what departs more than two standard deviations of the roughest part has another law


@dataclass(frozen=True, slots=True)
class Judged:
    """What is told of the last look: names with law, covariance of its values and departure; remainders."""

    laws: dict[EffectName, Law]
    covariance: dict[EffectName, Array]
    departure: dict[EffectName, float]
    ambiguous: tuple[tuple[EffectName, ...], ...]
    unknown: Unknown | None
    warnings: tuple[str, ...]


def find(
    arm: Arm, log: Log, advance: Advance | None = None, candidates: Collection[str] | None = None
) -> GapFinding:
    """What is hidden in a log of this arm; `candidates`: only these effects of the list, by name.

    Raises UnusableLogError where no answer is possible (another arm's log, degrees, runs that are too short).
    """
    return examine(arm, log, advance, candidates).finding


def examine(
    arm: Arm, log: Log, advance: Advance | None = None, candidates: Collection[str] | None = None
) -> DynamicOutcome:
    """`find`, with what a report shows beside the finding."""
    told = _rising(advance or silent)
    told("reading the runs", 0.0)
    recording = plausible(arm, prepare(arm, log))
    known = forms.known_terms(arm)
    rows = Rows(Physics(arm, recording), known)
    parts = split(recording, rows.table)
    scene = Scene(rows, known)
    look = looked(scene, known, parts, candidates, told)
    told("the gap on runs used for nothing else", 0.95)
    parts = parts.only(scene.kept)
    judged = _judged(look, parts.reporting)
    before = rows.residual(known)
    stages = _stages(look, judged, parts.reporting)
    after = -_without_blocks(look, tuple(judged.laws))
    moved = motion_gaps(rows.physics, known, (*known, *judged.laws.values()), parts.report_runs)
    finding = GapFinding(
        arm=arm.name,
        data=log.sources,
        noise_floor={**_floors(rows.table, arm), **_in_rad(moved, "floor_rad")},
        gap_before=gap(before, rows.table, parts.reporting),
        gap_after=gap(after, rows.table, parts.reporting),
        before_si={**_in_si(before, rows.table, parts.reporting, arm), **_in_rad(moved, "before_rad")},
        after_si={**_in_si(after, rows.table, parts.reporting, arm), **_in_rad(moved, "after_rad")},
        effects=stages,
        ambiguous=judged.ambiguous,
        unknown=judged.unknown or _silent(look, after, parts.reporting),
        nameable=_nameable(look),
        next_experiment=_next(recording, judged),
    )
    told("done", 1.0)
    warnings = (*recording.warnings, *_doubts(before, rows.table), *judged.warnings)
    names = tuple(run.name for run in recording.runs)
    ratios = tuple(drive.gear_ratio for drive in arm.drives)
    return DynamicOutcome(finding, warnings, rows.table, before, after, parts, names, ratios)


def _judged(look: Look, reporting: np.ndarray) -> Judged:
    """Names that are of a size worth one, keep their law, and hold on recordings that were not fitted."""
    size, covariance = look.evidence.estimate(look.best.members, look.best.kappa)
    laws: dict[EffectName, Law] = {}
    spread: dict[EffectName, Array] = {}
    departs: dict[EffectName, float] = {}
    other: list[tuple[float, str, EffectName | None]] = []
    said: list[str] = []
    first = 0
    for number in look.numbers:
        one = look.linear.terms[number]
        own = slice(first, first + one.count)
        first += one.count
        if one.key in look.decision.names and isinstance(one.key, EffectName) and one.law is not None:
            name, law = one.key, one.law(size[own])
            values, sd = size[own][: one.laws], np.sqrt(np.diag(covariance[own, own]))[: one.laws]
            departure = _departure(one, size[own])
            if not is_worth_a_name(look.around.scene.arm, law) or np.linalg.norm(values / sd) < SURE_sd:
                continue
            worth = _worth(look, number, reporting)
            if departure > LAW_MOST or worth < 0.0:
                bent = f"what {name} would explain departs too far from its law"
                words = bent if departure > LAW_MOST else f"{name} does not hold on the held-out runs"
                said.append(f"{words}: not named")
                other += [(abs(worth), words, name)] if abs(worth) > REMAINS else []
            else:
                laws[name], departs[name] = law, departure
                spread[name] = _of_values(one, size[own], covariance[own, own])
        elif isinstance(one.key, Block):
            worth = _worth(look, number, reporting)
            if one.words == CAMERA:
                late = float(size[own][0])
                said.append(f"the camera's times are {'late' if late < 0.0 else 'early'}: taken into account")
            elif worth > REMAINS and look.decision.probability.get(one.key, 0.0) > 0.5:
                other.append((worth, one.words, None))
    sets = tuple(names for names in look.decision.ambiguous if _is_material(look, names))
    return Judged(laws, spread, departs, sets, _unknown(look, other, laws, reporting), tuple(said))


def _unknown(
    look: Look,
    other: list[tuple[float, str, EffectName | None]],
    laws: dict[EffectName, Law],
    reporting: np.ndarray,
) -> Unknown | None:
    """The largest of what is left: its worth, words and rival."""
    if not other:
        return None
    _, words, rival = max(other, key=lambda one: one[0])
    return Unknown(words, rival or _nearest(look, laws), round(_explained(look, other, reporting), 3))


def _departure(one: SeriesTerm, size: Array) -> float:
    """Of the departures' coefficients over the law's: their columns are as large as its."""
    law = float(np.linalg.norm(size[: one.laws])) / np.sqrt(one.laws)
    return float(np.linalg.norm(size[one.laws : one.laws + one.departures])) / law if law > 0.0 else 0.0


def _of_values(one: SeriesTerm, size: Array, covariance: Array) -> Array:
    """Covariance of a law's values from that of all its coefficients."""
    if one.law is None:
        return np.zeros((0, 0))
    here = np.array(one.law(size).values)
    slopes = []
    for k in range(len(size)):
        moved = size.copy()
        step = 1e-3 * max(abs(float(size[0])), 1e-6)
        moved[k] += step
        slopes.append((np.array(one.law(moved).values) - here) / step)
    across = np.array(slopes).T
    return np.asarray(across @ covariance @ across.T)


def _worth(look: Look, number: int, reporting: np.ndarray) -> float:
    """By how much the squared gap of a cell grows on the rows kept apart, at most, without a term; negative where it shrinks."""
    whole, rest = left(look, look.numbers), left(look, look.numbers, [number])
    grown = []
    for cell in look.around.scene.cells:
        picked = reporting[cell.rows]
        if picked.any():
            grown.append(float(np.mean(rest[cell.rows][picked] ** 2 - whole[cell.rows][picked] ** 2)))
    return max(grown, key=abs, default=0.0)


def _explained(
    look: Look, other: Sequence[tuple[float, str, EffectName | None]], reporting: np.ndarray
) -> float:
    """Share of the excess over the floor that has a name."""
    total = float(np.mean(look.linear.y[reporting] ** 2)) if reporting.any() else 0.0
    worth = sum(max(one, 0.0) for one, _, _ in other)
    return float(np.clip(1.0 - worth / max(total, worth, 1e-9), 0.0, 1.0))


def _nearest(look: Look, laws: Collection[Key]) -> EffectName | None:
    others = [
        (p, key)
        for key, p in look.decision.probability.items()
        if isinstance(key, EffectName) and key not in laws
    ]
    return max(others, key=lambda one: one[0])[1] if others else None


def _is_material(look: Look, names: Sequence[EffectName]) -> bool:
    """Whether one of a set, as it is in the best set, is of a size worth a name."""
    laws = look.laws()
    return any(name in laws and is_worth_a_name(look.around.scene.arm, laws[name]) for name in names)


def _without_blocks(look: Look, names: Sequence[EffectName]) -> Array:
    """What names alone leave of all rows, as estimated without anything nameless, (rows,)."""
    return left(look, [k for k in look.numbers if look.linear.terms[k].key in names])


def _stages(look: Look, judged: Judged, reporting: np.ndarray) -> tuple[NamedEffect, ...]:
    """Names by what each explains, with the gap as they come in."""
    numbers = {look.linear.terms[k].key: k for k in look.numbers}
    table = look.around.scene.rows.table
    worth = {name: _worth(look, numbers[name], reporting) for name in judged.laws}
    total = sum(worth.values()) or 1.0
    found: list[NamedEffect] = []
    for name in sorted(worth, key=lambda one: -worth[one]):
        so_far = [*(one.name for one in found), name]
        after = gap(_without_blocks(look, so_far), table, reporting)
        evidence = {
            "probability": look.decision.probability[name],
            "share": worth[name] / total,
            "law_departure": judged.departure[name],
        }
        values = forms.parameters(judged.laws[name], judged.covariance[name])
        found.append(NamedEffect(name, values, after, evidence))
    return tuple(found)


def _silent(look: Look, after: Array, reporting: np.ndarray) -> Unknown | None:
    """What is left above the floor although no block takes it: the worst cell."""
    if not reporting.any():
        return None
    scene = look.around.scene
    sizes = [
        (float(np.sqrt(np.mean(after[c.rows][reporting[c.rows]] ** 2))), str(c))
        for c in scene.cells
        if reporting[c.rows].any()
    ]
    size, words = max(sizes)
    if gap(after, scene.rows.table, reporting) < SILENT_MOST:
        return None
    return Unknown(
        f"the {words}: {size:.1f} times its noise is left, and follows nothing that was tried", None, 0.0
    )


def _nameable(look: Look) -> tuple[Nameable, ...]:
    """Detectability of every effect's smallest size, and its rivals, whatever is nominal taken as right."""
    some: dict[Key, list[int]] = {}
    for number, one in enumerate(look.linear.terms):
        if isinstance(one.key, EffectName):
            some.setdefault(one.key, []).append(number)
    middle = [numbers[len(numbers) // 2] for numbers in some.values()]
    at = look.linear.at(middle)[look.linear.first :]
    evidence = Evidence(only(look.gram, at), [look.linear.terms[k] for k in middle], FLOOR_DOUBT)
    return tuple(
        dataclasses.replace(one, detectability=round(one.detectability / usual(one.name.effect), 2))
        for one in nameable(evidence)
    )


def _next(recording: Recording, judged: Judged) -> str | None:
    if judged.ambiguous:
        names = ", ".join(str(name) for name in judged.ambiguous[0])
        return f"a recording that separates {names}: {_advice(recording)}"
    if judged.unknown is not None:
        return f"more of where the unknown shows ({judged.unknown.where}): {_advice(recording)}"
    return None
