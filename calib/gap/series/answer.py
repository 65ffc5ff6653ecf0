"""The verdict on the last fit: names with law, parameters and departure, sets, and what is left."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.effects.catalogue import parameters
from calib.gap.effects.motor import SAMPLING
from calib.gap.finding import EffectName, Nameable, NamedEffect, Remainder, Unknown
from calib.gap.posterior.constants import FLOOR_DOUBT, LAW_MOST, REMAINS, SILENT_MOST
from calib.gap.posterior.decide import left_with, nameable
from calib.gap.posterior.evidence import Evidence
from calib.gap.posterior.term import Block, Key
from calib.gap.residuals.scene import SeriesTerm
from calib.gap.series.blocks import CAMERA
from calib.gap.series.file import Identified, identified
from calib.gap.series.linear import SeriesFit, left
from calib.gap.series.outcome import gap, in_si
from calib.gap.series.split import Picked, RowSplit
from calib.gap.series.validation import Member, bends, dominant_names, grown, members, with_only
from calib.gap.signals.terms import Law
from control.model.effects import EFFECTS

# Of a sample: what a voltage lies off on the whole that changed in steps nobody recorded.
THINNED = (0.43, 0.57)


@dataclass(frozen=True, slots=True)
class NamelessShape:
    """Something without a name: by how much the squared gap of a cell grows without it, its words, its term, and a
    name that may be it.
    """

    worth: float
    words: str
    number: int
    rival: EffectName | None = None


@dataclass(frozen=True, slots=True)
class SeriesVerdict:
    """The verdict on the last fit: names with law, covariance of its values and departure; what is left; corrections.

    `fit`: its best set without what was withdrawn; `corrected`: terms taken off as the sensors' own, with coefficients.
    `kept`: keys that explain something: names, how parts depart, and what is taken off.
    """

    fit: SeriesFit
    corrected: tuple[tuple[SeriesTerm, Array], ...]
    laws: dict[EffectName, Law]
    covariance: dict[EffectName, Array]
    departure: dict[EffectName, float]
    ambiguous: tuple[tuple[EffectName, ...], ...]
    unknown: Unknown | None
    remainder: tuple[Remainder, ...]
    kept: frozenset[Key]
    warnings: tuple[str, ...]


def judged(fit: SeriesFit, parts: RowSplit, harming: Sequence[Key]) -> SeriesVerdict:
    """Names that are of a size worth one, keep their law, hold on recordings that were not fitted, and help a file that has the
    laws alone.
    """
    reporting = parts.reporting
    said: list[str] = []
    other: list[NamelessShape] = []
    corrected, names = [], []
    for one in members(fit):
        key = one.term.key
        if one.term.curve is not None and one.size[0] < one.term.least:
            continue  # nearer to nought than its law's least, at which it would stand in the file or be taken off
        if correction := _correction(fit, one):
            said.append(correction)
            corrected.append(one.number)
        elif key in fit.decision.names and one.term.law is not None and one.is_sure:
            if not one.term.law(one.size).is_worth_a_name(fit.around.scene.given_Nm):
                continue
            if against := _against(fit, one, reporting):
                said.append(f"{against.words}: not named")
                other += [against] if abs(against.worth) > REMAINS else []
            else:
                names.append(one.number)
    named = dominant_names(fit, names, corrected, reporting)
    overshadowed = [_overshadowed(fit, k, [*named, *corrected], reporting) for k in names if k not in named]
    said += [f"{one.words}: not named" for one in overshadowed if one.worth > REMAINS]
    other += [one for one in overshadowed if one.worth > REMAINS]
    said += [f"{key} improves the fitted runs, but not the held-out ones: ignored" for key in harming]
    other += _contested(fit, reporting)
    some = with_only(fit, [*named, *corrected])
    file = identified(some, [one for one in members(some) if one.number in (*named, *corrected)], parts)
    for name, why in file.dropped.items():
        number = next(k for k in named if fit.linear.terms[k].key == name)
        said.append(f"{name} {why}: not named")
        left_out = NamelessShape(_worth(fit, number, reporting), f"{name} {why}", number, name)
        other += [left_out] if left_out.worth > REMAINS else []
    named = [k for k in named if fit.linear.terms[k].key not in file.dropped]
    sets = tuple(group for group in fit.decision.ambiguous if _is_material(fit, group))
    return _verdict(fit, with_only(fit, [*named, *corrected]), named, file, other, sets, harming, said, reporting)


def _verdict(
    whole: SeriesFit,
    fit: SeriesFit,
    named: Collection[int],
    file: Identified,
    other: Sequence[NamelessShape],
    sets: tuple[tuple[EffectName, ...], ...],
    harming: Sequence[Key],
    said: Sequence[str],
    reporting: Picked,
) -> SeriesVerdict:
    """Of a fit whose best set has what is named or taken off, and blocks; `whole` has what was withdrawn, too."""
    laws: dict[EffectName, Law] = {}
    spread: dict[EffectName, Array] = {}
    departs: dict[EffectName, float] = {}
    kept: set[Key] = set()
    some = list(members(fit))
    corrected = tuple((one.term, file.size[one.number]) for one in some if one.number in file.size and one.number not in named)
    for one in some:
        key = one.term.key
        if isinstance(key, Block) and one.term.words != CAMERA:
            continue
        kept.add(key)
        if isinstance(key, EffectName) and one.number in named and one.term.law is not None:
            own = dataclasses.replace(one, size=file.size[one.number], covariance=file.covariance[one.number])
            laws[key], departs[key], spread[key] = (one.term.law(own.size).bounded(), one.departure, covariance_of_values(own))
    left_over = list(other)
    for one in some:
        key = one.term.key
        is_open = any(key in group for group in fit.decision.remainders)
        is_likely = is_open or fit.decision.probability.get(key, 0.0) > 0.5
        if not isinstance(key, Block) or key in kept or not is_likely:
            continue
        worth = _worth(fit, one.number, reporting)
        if worth <= REMAINS:
            continue
        law, share = bends(fit, one, [own for own in some if own.term.key in laws])
        if law is None:
            left_over.append(NamelessShape(worth, one.term.words, one.number))
        else:
            departs[law] = math.hypot(departs[law], share)
            kept.add(key)
    remainder = _remainder(whole, left_over, reporting)
    explained = kept.union(*sets)  # one of a set explains what it does, whichever it is
    unknown = _unknown(whole, left_over, kept) or _silent(whole, what_is_left(whole, explained), reporting, harming)
    return SeriesVerdict(fit, corrected, laws, spread, departs, sets, unknown, remainder, frozenset(kept), tuple(said))


def _overshadowed(fit: SeriesFit, number: int, others: Sequence[int], reporting: Picked) -> NamelessShape:
    """A name beside which more is left than it explains."""
    name = fit.linear.terms[number].key
    assert isinstance(name, EffectName)
    rest = with_only(fit, others).numbers
    worth = grown(fit, left(fit, rest), left(fit, [*rest, number]), reporting)
    return NamelessShape(worth, f"the residual is larger than what {name} explains", number, name)


def _correction(fit: SeriesFit, one: Member) -> str:
    """When camera or currents are read is no effect of the arm: said, and taken off."""
    if one.term.words == CAMERA:
        time_ms = 1e3 * float(one.size[0]) * one.term.size
        way = "late" if time_ms < 0.0 else "early"
        return f"the camera's times are {abs(time_ms):.2f} ms {way}: corrected"
    if isinstance(one.term.key, EffectName) and one.term.key.effect == SAMPLING and one.term.law is not None:
        # as the refit has it; beside nuisances, a command that is late by as little says the same
        time_ms = 1e3 * fit.around.found.get(one.term.key, one.term.law(one.size)).values[0]
        if THINNED[0] < 1e-3 * time_ms * fit.around.scene.recording.filters.rate_Hz < THINNED[1]:
            return (
                "other voltages were held between these samples, half a sample away on the whole: was the log thinned out?"
                " Corrected; record every sample"
            )
        than = (
            "after the voltage of their line took effect"
            if fit.around.scene.recording.has_voltage
            else "before the end of a step of the voltage"
        )
        return f"angles and currents are read {time_ms:.2f} ms {than}: corrected"
    return ""


def _against(fit: SeriesFit, one: Member, reporting: Picked) -> NamelessShape | None:
    """Why a name cannot stand, if it cannot."""
    name, worth = one.term.key, _worth(fit, one.number, reporting)
    rival = name if isinstance(name, EffectName) else None
    # Every gear has friction: what departs from Coulomb's or the viscous law is that friction all the same.
    if one.departure > LAW_MOST and not one.term.is_common:
        return NamelessShape(worth, f"what {name} would explain departs too far from its law", one.number, rival)
    if worth < 0.0:
        return NamelessShape(worth, f"{name} improves the fitted runs, but not the held-out ones", one.number, rival)
    return None


def _contested(fit: SeriesFit, reporting: Picked) -> Iterator[NamelessShape]:
    """Names of the best set in whose place something nameless may stand."""
    for group in fit.decision.remainders:
        blocks = [key for key in group if isinstance(key, Block)]
        for number in fit.numbers:
            key = fit.linear.terms[number].key
            if key in group and isinstance(key, EffectName):
                words = next(one.words for one in fit.linear.terms if one.key == blocks[0])
                worth = _worth(fit, number, reporting)
                if worth > REMAINS:
                    yield NamelessShape(worth, f"{words}, or {key}", number, key)


def covariance_of_values(one: Member) -> Array:
    """Covariance of a law's values from that of all its coefficients, with how far the values are from where these put them.

    A linearisation speaks for its law in part of the range alone, and no value is below nought: at such an end a value stays
    although its coefficient goes on, and is known no better for it. So the slopes are those inside.
    """
    assert one.term.law is not None
    inside = one.size.copy()
    inside[one.term.laws + one.term.departures :] = 0.0
    if one.term.curve is not None:
        inside[0] = one.term.curve.start / one.term.curve.size
    here, step = np.array(one.term.law(inside).values), 1e-3 * max(abs(float(inside[0])), 1e-6)
    moved = [np.array(one.term.law(inside + step * way).values) - here for way in np.eye(len(inside))]
    slopes = np.array(moved).T / step
    beyond = here + slopes @ (one.size - inside) - one.term.law(one.size).bounded().values
    return np.asarray(slopes @ one.covariance @ slopes.T + np.outer(beyond, beyond))


def _worth(fit: SeriesFit, number: int, reporting: Picked) -> float:
    """By how much the squared gap of a cell grows on the rows kept apart, at most, without a term; negative where it shrinks."""
    return grown(fit, left(fit, fit.numbers, [number]), left(fit, fit.numbers), reporting)


def what_is_left(fit: SeriesFit, keys: Collection[Key]) -> Array:
    """What these leave of all rows beside how what is known departs, as estimated beside blocks, (rows,)."""
    terms = fit.linear.terms
    drop = [k for k in fit.numbers if terms[k].key not in keys and isinstance(terms[k].key, Block)]
    return left(fit, [k for k in fit.numbers if terms[k].key in keys or k in drop], drop)


def _unknown(fit: SeriesFit, other: Sequence[NamelessShape], kept: Collection[Key]) -> Unknown | None:
    """The largest of what is left."""
    if not other:
        return None
    one = max(other, key=lambda one: one.worth)
    nearest, share = _nearest(fit, kept)
    return Unknown(one.words, one.rival or nearest, round(share, 3))


def _silent(fit: SeriesFit, after: Array, reporting: Picked, harming: Sequence[Key]) -> Unknown | None:
    """What is left above the floor although no block takes it: the worst cell, and the name that was withdrawn, if one was."""
    scene = fit.around.scene
    rivals = [key for key in harming if isinstance(key, EffectName) and key.effect in EFFECTS]
    most = math.sqrt(1.0 + REMAINS) if rivals else SILENT_MOST
    if not reporting.any() or gap(after, scene.rows.table, reporting) < most:
        return None
    size, words = max(
        (float(np.sqrt(np.mean(after[c.rows][reporting[c.rows]] ** 2))), str(c)) for c in scene.cells if reporting[c.rows].any()
    )
    return Unknown(
        f"the {words}: a residual of {size:.1f} times its noise, correlated with nothing that was tried",
        rivals[0] if rivals else None,
        0.0,
    )


def _nearest(fit: SeriesFit, kept: Collection[Key]) -> tuple[EffectName | None, float]:
    """The effect that is not named and explains most beside the names, and its share of what these leave."""
    evidence, best, terms = fit.evidence, fit.best, fit.linear.terms
    named = tuple(one for one in best.members if terms[one[0]].key in kept)
    added = evidence.added(named, best.kappa)
    others = [
        k for k, one in enumerate(terms) if isinstance(one.key, EffectName) and one.key.effect in EFFECTS and one.key not in kept
    ]
    if not others:
        return None, 0.0
    top = max(others, key=lambda k: float(added.log[k]))
    alone = left_with(evidence, dataclasses.replace(best, members=named))
    excess = alone - left_with(evidence, best)
    at = np.concatenate([np.zeros(0, np.intp), *(evidence.places[number] for number, _ in named)])
    law = evidence.places[top][: terms[top].laws]  # without departures, which could bend it to anything
    seen, pull = evidence.gram.tip, evidence.gram.pull
    taken = np.linalg.lstsq(seen[np.ix_(at, at)], np.column_stack((seen[np.ix_(at, law)], pull[at])), rcond=None)[0]
    own = seen[np.ix_(law, law)] - seen[np.ix_(law, at)] @ taken[:, :-1]
    drawn = pull[law] - seen[np.ix_(law, at)] @ taken[:, -1]
    explained = float(drawn @ np.linalg.lstsq(own, drawn, rcond=None)[0])
    key = terms[top].key
    return (key if isinstance(key, EffectName) else None), (float(np.clip(explained / excess, 0.0, 1.0)) if excess > 0.0 else 0.0)


def _remainder(fit: SeriesFit, other: Sequence[NamelessShape], reporting: Picked) -> tuple[Remainder, ...]:
    """What is left without one name, the largest first."""
    whole = left(fit, fit.numbers)
    scene = fit.around.scene
    found = []
    for one in sorted(other, key=lambda one: -one.worth):
        if one.worth > 0.0:
            moved = left(fit, fit.numbers, [one.number]) - whole
            size = {
                channel: value for channel, value in in_si(moved, scene.rows.table, reporting, scene.arm).items() if value > 0.0
            }
            found.append(Remainder(one.words, _share(fit, one.number), size))
    return tuple(found)


def _share(fit: SeriesFit, number: int) -> float:
    """Of the excess of all rows that decide over what the best set leaves, what a term explains."""
    whole = left_with(fit.evidence, fit.best)
    excess = fit.evidence.gram.left - whole
    rest = dataclasses.replace(fit.best, members=tuple(one for one in fit.best.members if one[0] != number))
    return float(np.clip((left_with(fit.evidence, rest) - whole) / excess, 0.0, 1.0)) if excess > 0.0 else 0.0


def _is_material(fit: SeriesFit, names: Sequence[EffectName]) -> bool:
    """Whether one of a set, as it is in the best set, is of a size worth a name."""
    laws = fit.laws()
    return any(name in laws and laws[name].is_worth_a_name(fit.around.scene.given_Nm) for name in names)


def seen_by_sensors(verdict: SeriesVerdict, count: int) -> Array:
    """What is taken off as the sensors' own and is no law, of all rows (count,)."""
    found = np.zeros(count)
    for one, size in verdict.corrected:
        for cell, own in one.response.items() if one.law is None else ():
            found[verdict.fit.around.scene.cells[cell].rows] += own @ size
    return found


def named_effects(verdict: SeriesVerdict) -> tuple[NamedEffect, ...]:
    """Names by what each explains, without a gap yet."""
    fit = verdict.fit
    numbers = {fit.linear.terms[k].key: k for k in fit.numbers}
    share = {name: _share(fit, numbers[name]) for name in verdict.laws}
    return tuple(
        NamedEffect(
            name,
            parameters(fit.around.scene.arm, verdict.laws[name], verdict.covariance[name]),
            math.nan,
            probability=fit.decision.probability[name],
            share=share[name],
            departure=verdict.departure[name],
            variable=fit.linear.terms[numbers[name]].variable,
        )
        for name in sorted(share, key=lambda one: -share[one])
    )


def nameable_effects(fit: SeriesFit) -> tuple[Nameable, ...]:
    """Detectability of every effect's usual size, and its rivals, whatever is nominal taken as right."""
    some: dict[Key, list[int]] = {}
    for number, one in enumerate(fit.linear.terms):
        if isinstance(one.key, EffectName) and one.key.effect in EFFECTS:
            some.setdefault(one.key, []).append(number)
    middle = [numbers[len(numbers) // 2] for numbers in some.values()]
    if not middle:
        return ()
    at = fit.linear.at(middle)[fit.linear.first :]
    evidence = Evidence(fit.gram.of(at), [fit.linear.terms[k] for k in middle], FLOOR_DOUBT)
    return nameable(evidence)
