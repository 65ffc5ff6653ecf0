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
from calib.gap.finding import EffectName, Nameable, NamedEffect, Remainder, Unknown, values_alone
from calib.gap.posterior.constants import FLOOR_DOUBT, LAW_MOST, REMAINS, SILENT_MOST, UNTOLD
from calib.gap.posterior.decide import left_with, nameable
from calib.gap.posterior.evidence import Evidence
from calib.gap.posterior.term import Block, Key
from calib.gap.residuals.scene import SeriesTerm
from calib.gap.series.blocks import CAMERA
from calib.gap.series.file import Identified, identified
from calib.gap.series.linear import SeriesFit, residual_of
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

    `posterior`: the laws as they are beside all that has no name;
    `fit`: its best set without what was withdrawn; `corrected`: terms taken off as the sensors' own, with coefficients;
    `refitted`: changes of what the arm's file has beside the names.
    `explaining`: keys that explain something: names, how parts depart, and what is taken off.
    """

    fit: SeriesFit
    corrected: tuple[tuple[SeriesTerm, Array], ...]
    laws: dict[EffectName, Law]
    posterior: dict[EffectName, Law]
    covariance: dict[EffectName, Array]
    departure: dict[EffectName, float]
    refitted: tuple[Member, ...]
    ambiguous: tuple[tuple[EffectName, ...], ...]
    unknown: Unknown | None
    remainder: tuple[Remainder, ...]
    explaining: frozenset[Key]
    warnings: tuple[str, ...]


def judged(fit: SeriesFit, parts: RowSplit, harming: Sequence[Key]) -> SeriesVerdict:
    """Names that are of a size worth one, keep their law, hold on recordings that were not fitted, and help a file that has the
    laws alone.
    """
    reporting = parts.reporting
    sentences: list[str] = []
    nameless: list[NamelessShape] = []
    corrected, names = [], []
    for member in members(fit):
        key = member.term.key
        if member.term.curve is not None and member.size[0] < member.term.least:
            continue  # nearer to nought than its law's least, at which it would stand in the file or be taken off
        if correction := _correction(fit, member):
            sentences.append(correction)
            corrected.append(member.number)
        elif key in fit.decision.names and member.term.law is not None and member.is_sure:
            if not member.term.law(member.size).is_worth_a_name(fit.point.scene.given_Nm):
                continue
            if against := _against(fit, member, reporting):
                sentences.append(f"{against.words}: not named")
                nameless += [against] if abs(against.worth) > REMAINS else []
            else:
                names.append(member.number)
    named = dominant_names(fit, names, corrected, reporting)
    overshadowed = [_overshadowed(fit, k, [*named, *corrected], reporting) for k in names if k not in named]
    sentences += [f"{shape.words}: not named" for shape in overshadowed if shape.worth > REMAINS]
    nameless += [shape for shape in overshadowed if shape.worth > REMAINS]
    sentences += [f"{key} improves the fitted runs, but not the held-out ones: ignored" for key in harming]
    nameless += _contested(fit, reporting)
    reduced = with_only(fit, [*named, *corrected])
    file = identified(reduced, [member for member in members(reduced) if member.number in (*named, *corrected)], parts)
    for number in [k for k in named if fit.linear.terms[k].key in file.dropped]:
        name = fit.linear.terms[number].key
        assert isinstance(name, EffectName)
        why = file.dropped[name]
        sentences.append(f"{name} {why}: not named")
        left_out = NamelessShape(_worth(fit, number, reporting), f"{name} {why}", number, name)
        nameless += [left_out] if left_out.worth > REMAINS else []
    named = [k for k in named if fit.linear.terms[k].key not in file.dropped]
    sets = tuple(group for group in fit.decision.ambiguous if _is_material(fit, group))
    return _verdict(fit, with_only(fit, [*named, *corrected]), named, file, nameless, sets, harming, sentences, reporting)


def _verdict(
    whole: SeriesFit,
    fit: SeriesFit,
    named: Collection[int],
    file: Identified,
    nameless: Sequence[NamelessShape],
    sets: tuple[tuple[EffectName, ...], ...],
    harming: Sequence[Key],
    sentences: Sequence[str],
    reporting: Picked,
) -> SeriesVerdict:
    """Of a fit whose best set has what is named or taken off, and blocks; `whole` has what was withdrawn, too."""
    laws: dict[EffectName, Law] = {}
    posterior: dict[EffectName, Law] = {}
    spread: dict[EffectName, Array] = {}
    departs: dict[EffectName, float] = {}
    explaining: set[Key] = set()
    best_set = list(members(fit))
    corrected = tuple((m.term, file.size[m.number]) for m in best_set if m.number in file.size and m.number not in named)
    for member in best_set:
        key = member.term.key
        if isinstance(key, Block) and member.term.words != CAMERA:
            continue
        explaining.add(key)
        if isinstance(key, EffectName) and member.number in named and member.term.law is not None:
            filed = dataclasses.replace(member, size=file.size[member.number], covariance=file.covariance[member.number])
            laws[key], departs[key] = member.term.law(filed.size).bounded(), member.departure
            spread[key], posterior[key] = covariance_of_values(filed), member.term.law(member.size).bounded()
    left_over = list(nameless)
    for member in best_set:
        key = member.term.key
        is_open = any(key in group for group in fit.decision.remainders)
        is_likely = is_open or fit.decision.probability.get(key, 0.0) > 0.5
        if not isinstance(key, Block) or key in explaining or not is_likely:
            continue
        worth = _worth(fit, member.number, reporting)
        if worth <= REMAINS:
            continue
        law, share = bends(fit, member, [named_member for named_member in best_set if named_member.term.key in laws])
        if law is None:
            left_over.append(NamelessShape(worth, member.term.words, member.number))
        else:
            departs[law] = math.hypot(departs[law], share)
            explaining.add(key)
    remainder = _remainder(whole, left_over, reporting)
    explained = explaining.union(*sets)  # one of a set explains what it does, whichever it is
    unknown = _unknown(whole, left_over, explaining) or _silent(whole, what_is_left(whole, explained), reporting, harming)
    return SeriesVerdict(
        fit,
        corrected,
        laws,
        posterior,
        spread,
        departs,
        file.refitted,
        sets,
        unknown,
        remainder,
        frozenset(explaining),
        tuple(sentences),
    )


def _overshadowed(fit: SeriesFit, number: int, others: Sequence[int], reporting: Picked) -> NamelessShape:
    """A name beside which more is left than it explains."""
    name = fit.linear.terms[number].key
    assert isinstance(name, EffectName)
    rest = with_only(fit, others).numbers
    worth = grown(fit, residual_of(fit, rest), residual_of(fit, [*rest, number]), reporting)
    return NamelessShape(worth, f"the residual is larger than what {name} explains", number, name)


def _correction(fit: SeriesFit, member: Member) -> str:
    """When camera or currents are read is no effect of the arm: said, and taken off."""
    if member.term.words == CAMERA:
        time_ms = 1e3 * float(member.size[0]) * member.term.size
        way = "late" if time_ms < 0.0 else "early"
        return f"the camera's times are {abs(time_ms):.2f} ms {way}: corrected"
    if isinstance(member.term.key, EffectName) and member.term.key.effect == SAMPLING and member.term.law is not None:
        # as the refit has it; beside nuisances, a command that is late by as little says the same
        time_ms = 1e3 * fit.point.laws.get(member.term.key, member.term.law(member.size)).values[0]
        if THINNED[0] < 1e-3 * time_ms * fit.point.scene.recording.filters.rate_Hz < THINNED[1]:
            return (
                "other voltages were held between these samples, half a sample away on the whole: was the log thinned out?"
                " Corrected; record every sample"
            )
        than = (
            "after the voltage of their line took effect"
            if fit.point.scene.recording.has_voltage
            else "before the end of a step of the voltage"
        )
        return f"angles and currents are read {time_ms:.2f} ms {than}: corrected"
    return ""


def _against(fit: SeriesFit, member: Member, reporting: Picked) -> NamelessShape | None:
    """Why a name cannot stand, if it cannot."""
    name, worth = member.term.key, _worth(fit, member.number, reporting)
    rival = name if isinstance(name, EffectName) else None
    # Every gear has friction: what departs from Coulomb's or the viscous law is that friction all the same.
    if member.departure > LAW_MOST and not member.term.is_common:
        return NamelessShape(worth, f"what {name} would explain departs too far from its law", member.number, rival)
    if worth < -REMAINS:
        return NamelessShape(worth, f"{name} improves the fitted runs, but not the held-out ones", member.number, rival)
    return None


def _contested(fit: SeriesFit, reporting: Picked) -> Iterator[NamelessShape]:
    """Names of the best set in whose place something nameless may stand."""
    for group in fit.decision.remainders:
        blocks = [key for key in group if isinstance(key, Block)]
        for number in fit.numbers:
            key = fit.linear.terms[number].key
            if key in group and isinstance(key, EffectName):
                words = next(term.words for term in fit.linear.terms if term.key == blocks[0])
                worth = _worth(fit, number, reporting)
                if worth > REMAINS:
                    yield NamelessShape(worth, f"{words}, or {key}", number, key)


def covariance_of_values(member: Member) -> Array:
    """Covariance of a law's values from that of all its coefficients, with how far the values are from where these put them.

    A linearisation speaks for its law in part of the range alone, and no value is below nought: at such an end a value stays
    although its coefficient goes on, and is known no better for it. So the slopes are those inside.
    """
    assert member.term.law is not None
    inside = member.size.copy()
    inside[member.term.laws + member.term.departures :] = 0.0
    if member.term.curve is not None:
        inside[0] = member.term.curve.start / member.term.curve.size
    here, step = np.array(member.term.law(inside).values), 1e-3 * max(abs(float(inside[0])), 1e-6)
    moved = [np.array(member.term.law(inside + step * way).values) - here for way in np.eye(len(inside))]
    slopes = np.array(moved).T / step
    beyond = here + slopes @ (member.size - inside) - member.term.law(member.size).bounded().values
    return np.asarray(slopes @ member.covariance @ slopes.T + np.outer(beyond, beyond))


def _worth(fit: SeriesFit, number: int, reporting: Picked) -> float:
    """By how much the squared gap of a cell grows on the rows kept apart, at most, without a term; negative where it shrinks."""
    return grown(fit, residual_of(fit, fit.numbers, [number]), residual_of(fit, fit.numbers), reporting)


def what_is_left(fit: SeriesFit, keys: Collection[Key]) -> Array:
    """What these leave of all rows beside how what is known departs, as estimated beside blocks, (rows,)."""
    terms = fit.linear.terms
    drop = [k for k in fit.numbers if terms[k].key not in keys and isinstance(terms[k].key, Block)]
    return residual_of(fit, [k for k in fit.numbers if terms[k].key in keys or k in drop], drop)


def _unknown(fit: SeriesFit, nameless: Sequence[NamelessShape], explaining: Collection[Key]) -> Unknown | None:
    """The largest of what is left."""
    if not nameless:
        return None
    largest = max(nameless, key=lambda largest: largest.worth)
    nearest, share = _nearest(fit, explaining)
    return Unknown(largest.words, largest.rival or nearest, round(share, 3))


def _silent(fit: SeriesFit, after: Array, reporting: Picked, harming: Sequence[Key]) -> Unknown | None:
    """What is left above the floor although no block takes it: the worst cell, and the name that was withdrawn, if one was."""
    scene = fit.point.scene
    rivals = [key for key in harming if isinstance(key, EffectName) and key.effect in EFFECTS]
    most = UNTOLD if rivals else SILENT_MOST
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


def _nearest(fit: SeriesFit, explaining: Collection[Key]) -> tuple[EffectName | None, float]:
    """The effect that is not named and explains most beside the names, and its share of what these leave."""
    evidence, best, terms = fit.evidence, fit.best, fit.linear.terms
    named = tuple(entry for entry in best.members if terms[entry[0]].key in explaining)
    added = evidence.added(named, best.kappa)
    others = [
        k for k, t in enumerate(terms) if isinstance(t.key, EffectName) and t.key.effect in EFFECTS and t.key not in explaining
    ]
    if not others:
        return None, 0.0
    top = max(others, key=lambda k: float(added.log[k]))
    alone = left_with(evidence, dataclasses.replace(best, members=named))
    excess = alone - left_with(evidence, best)
    at = np.concatenate([np.zeros(0, np.intp), *(evidence.places[number] for number, _ in named)])
    law = evidence.places[top][: terms[top].laws]  # without departures, which could bend it to anything
    seen, pull = evidence.gram.tip, evidence.gram.pull
    shared = np.linalg.lstsq(seen[np.ix_(at, at)], np.column_stack((seen[np.ix_(at, law)], pull[at])), rcond=None)[0]
    apart = seen[np.ix_(law, law)] - seen[np.ix_(law, at)] @ shared[:, :-1]
    drawn = pull[law] - seen[np.ix_(law, at)] @ shared[:, -1]
    explained = float(drawn @ np.linalg.lstsq(apart, drawn, rcond=None)[0])
    key = terms[top].key
    return (key if isinstance(key, EffectName) else None), (float(np.clip(explained / excess, 0.0, 1.0)) if excess > 0.0 else 0.0)


def _remainder(fit: SeriesFit, nameless: Sequence[NamelessShape], reporting: Picked) -> tuple[Remainder, ...]:
    """What is left without one name, the largest first."""
    whole = residual_of(fit, fit.numbers)
    scene = fit.point.scene
    remainders = []
    for shape in sorted(nameless, key=lambda shape: -shape.worth):
        if shape.worth > 0.0:
            moved = residual_of(fit, fit.numbers, [shape.number]) - whole
            size = {
                channel: value for channel, value in in_si(moved, scene.rows.table, reporting, scene.arm).items() if value > 0.0
            }
            remainders.append(Remainder(shape.words, _share(fit, shape.number), size))
    return tuple(remainders)


def _share(fit: SeriesFit, number: int) -> float:
    """Of the excess of all rows that decide over what the best set leaves, what a term explains."""
    whole = left_with(fit.evidence, fit.best)
    excess = fit.evidence.gram.left - whole
    rest = dataclasses.replace(fit.best, members=tuple(entry for entry in fit.best.members if entry[0] != number))
    return float(np.clip((left_with(fit.evidence, rest) - whole) / excess, 0.0, 1.0)) if excess > 0.0 else 0.0


def _is_material(fit: SeriesFit, names: Sequence[EffectName]) -> bool:
    """Whether one of a set, as it is in the best set, is of a size worth a name."""
    laws = fit.laws()
    return any(name in laws and laws[name].is_worth_a_name(fit.point.scene.given_Nm) for name in names)


def seen_by_sensors(verdict: SeriesVerdict, count: int) -> Array:
    """What is taken off as the sensors' own and is no law, of all rows (count,)."""
    sensed = np.zeros(count)
    for term, size in verdict.corrected:
        for cell, columns in term.response.items() if term.law is None else ():
            sensed[verdict.fit.point.scene.cells[cell].rows] += columns @ size
    return sensed


def named_effects(verdict: SeriesVerdict) -> tuple[NamedEffect, ...]:
    """Names by what each explains, without a gap yet."""
    fit = verdict.fit
    numbers = {fit.linear.terms[k].key: k for k in fit.numbers}
    share = {name: _share(fit, numbers[name]) for name in verdict.laws}
    return tuple(
        NamedEffect(
            name,
            parameters(fit.point.scene.arm, verdict.laws[name], verdict.covariance[name]),
            math.nan,
            beside=values_alone(parameters(fit.point.scene.arm, verdict.posterior[name], verdict.covariance[name])),
            probability=fit.decision.probability[name],
            share=share[name],
            departure=verdict.departure[name],
            variable=fit.linear.terms[numbers[name]].variable,
        )
        for name in sorted(share, key=lambda key: -share[key])
    )


def refitted_effects(verdict: SeriesVerdict) -> tuple[NamedEffect, ...]:
    """Changes of what the arm's file has beside the names."""
    arm = verdict.fit.point.scene.arm
    return tuple(
        NamedEffect(member.term.key, parameters(arm, member.term.law(member.size), covariance_of_values(member)), math.nan)
        for member in verdict.refitted
        if isinstance(member.term.key, EffectName) and member.term.law is not None
    )


def nameable_effects(fit: SeriesFit) -> tuple[Nameable, ...]:
    """Detectability of every effect's usual size, and its rivals, whatever is nominal taken as right."""
    variants: dict[Key, list[int]] = {}
    for number, term in enumerate(fit.linear.terms):
        if isinstance(term.key, EffectName) and term.key.effect in EFFECTS:
            variants.setdefault(term.key, []).append(number)
    middle = [numbers[len(numbers) // 2] for numbers in variants.values()]
    if not middle:
        return ()
    at = fit.linear.at(middle)[fit.linear.first :]
    evidence = Evidence(fit.gram.beside(at, with_first=False), [fit.linear.terms[k] for k in middle], FLOOR_DOUBT)
    return nameable(evidence)
