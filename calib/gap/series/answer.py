"""What is told of the last look: names with law, parameters and departure, sets, what is left, and what would settle it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.finding import EffectName, Nameable, NamedEffect, OpenQuestion, Remainder, Unknown
from calib.gap.posterior.constants import DEPARTURES, FLOOR_DOUBT
from calib.gap.posterior.decide import left_with
from calib.gap.posterior.evidence import Evidence
from calib.gap.posterior.nameable import nameable
from calib.gap.posterior.parameters import is_exact
from calib.gap.posterior.term import Block, Key
from calib.gap.residuals.sizes import is_worth_a_name
from calib.gap.series.blocks import CAMERA
from calib.gap.series.constants import GROWS, REMAINS, SILENT_MOST, SURE_sd
from calib.gap.series.effects import SAMPLING
from calib.gap.series.linear import only
from calib.gap.series.look import Look, left
from calib.gap.series.outcome import gap, in_si
from calib.gap.series.split import Picked
from calib.gap.series.term import SeriesTerm
from calib.gap.signals import forms
from calib.gap.signals.recording import Recording
from calib.gap.signals.terms import Term as Law
from control.model.effects import EFFECTS

# Of a sample: what a voltage lies off on the whole that changed in steps nobody recorded.
THINNED = (0.43, 0.57)
OF_THE_TIP = (
    "backlash", "joint_compliance", "link_flexure", "encoder_scale", "encoder_eccentricity", "belt_coupling",
)  # fmt: skip
NEGLIGIBLE = 0.005  # of all weight: a size of it does not count
# What departs more than two standard deviations of the roughest part has another law.
LAW_MOST = 2.0 * max(DEPARTURES)


@dataclass(frozen=True, slots=True)
class Left:
    """Something without a name: by how much the squared gap of a cell grows without it, its words, its term, and a
    name that may be it.
    """

    worth: float
    words: str
    number: int
    rival: EffectName | None = None


@dataclass(frozen=True, slots=True)
class Judged:
    """What is told of the last look: names with law, covariance of its values and departure; what is left; corrections.

    `kept`: keys that stay in the model: names, and what is taken off as the sensors' own.
    """

    laws: dict[EffectName, Law]
    covariance: dict[EffectName, Array]
    departure: dict[EffectName, float]
    ambiguous: tuple[tuple[EffectName, ...], ...]
    unknown: Unknown | None
    remainder: tuple[Remainder, ...]
    kept: frozenset[Key]
    harming: tuple[Key, ...]
    """What was withdrawn, as the runs kept apart are better without it."""
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Member:
    """A term of the best set by number, with its coefficients and their covariance."""

    number: int
    term: SeriesTerm
    size: Array
    covariance: Array

    @property
    def is_sure(self) -> bool:
        """Whether its law is not nothing."""
        laws = slice(0, self.term.laws)
        sd = np.sqrt(np.diag(self.covariance)[laws])
        return bool(np.linalg.norm(self.size[laws] / sd) >= SURE_sd)

    @property
    def departure(self) -> float:
        """Of the departures' coefficients over the law's: their columns are as large as its."""
        one = self.term
        law = float(np.linalg.norm(self.size[: one.laws])) / np.sqrt(one.laws)
        departs = float(np.linalg.norm(self.size[one.laws : one.laws + one.departures]))
        return departs / law if law > 0.0 else 0.0


def _members(look: Look) -> Iterator[Member]:
    """Each averaged over how large it and its departures may be, all others at their best.

    An exact law is left out of that where a law may depart: an interval holds only if it counts departures that do not show.
    """
    evidence, best = look.evidence, look.best
    for number in look.numbers:
        rest = [one for one in best.members if one[0] != number]
        ways = [
            [*rest, (number, scale)]
            for scale in range(len(evidence.weights[number]))
            if not is_exact(evidence, number, scale)
        ]
        logs = np.array([evidence.value(way, best.kappa) for way in ways])
        share = np.exp(logs - logs.max())
        share /= share.sum()
        own = slice(-look.linear.terms[number].count, None)
        found = [
            (weight, *evidence.estimate(way, best.kappa))
            for weight, way in zip(share.tolist(), ways, strict=True)
            if weight > NEGLIGIBLE
        ]
        mean = sum((weight * size[own] for weight, size, _ in found), np.zeros(1))
        covariance = sum(
            (
                weight * (spread[own, own] + np.outer(size[own] - mean, size[own] - mean))
                for weight, size, spread in found
            ),
            np.zeros((1, 1)),
        )
        yield Member(number, look.linear.terms[number], np.asarray(mean), np.asarray(covariance))


def borne_out(look: Look, reporting: Picked) -> tuple[Look, list[Key]]:
    """The look whose best set is estimated without what does not help the runs kept apart, and the names that harm them.

    The measured acceleration has noise, and the residual has it, too: blocks that follow it are drawn to a late command, or to
    what else shifts the currents, and each cancels the other. So blocks are tried beside names that do no harm by themselves.
    """
    table, terms = look.around.scene.rows.table, look.linear.terms
    blocks = [k for k in look.numbers if isinstance(terms[k].key, Block) and terms[k].words != CAMERA]
    names = [k for k in look.numbers if k not in blocks]
    sound = _harmless(look, names, reporting)
    helping: list[int] = []
    while left_over := [k for k in blocks if k not in helping]:
        here = left(look, [*sound, *helping])
        tried = {k: left(look, [*sound, *helping, k]) for k in left_over}
        best = min(left_over, key=lambda k: gap(tried[k], table, reporting))
        if _grown(look, here, tried[best], reporting) <= REMAINS:
            break
        helping.append(best)
    members = tuple(one for one in look.best.members if one[0] in (*sound, *helping))
    best_set = dataclasses.replace(look.best, members=members)
    harming = [terms[k].key for k in names if k not in sound]
    return dataclasses.replace(look, decision=dataclasses.replace(look.decision, best=best_set)), harming


def _harmless(look: Look, numbers: Sequence[int], reporting: Picked) -> list[int]:
    """Those without which the gap on the runs kept apart does not shrink, each time estimated again."""
    table, sound = look.around.scene.rows.table, list(numbers)
    while sound:
        size = gap(left(look, sound), table, reporting)
        without = {k: gap(left(look, [one for one in sound if one != k]), table, reporting) for k in sound}
        worst = min(sound, key=lambda k: without[k])
        if not without[worst] ** 2 < (1.0 - GROWS) * size**2:
            break
        sound.remove(worst)
    return sound


def judged(look: Look, reporting: Picked, harming: Sequence[Key]) -> Judged:
    """Names that are of a size worth one, keep their law, and hold on recordings that were not fitted."""
    laws: dict[EffectName, Law] = {}
    spread: dict[EffectName, Array] = {}
    departs: dict[EffectName, float] = {}
    other: list[Left] = []
    kept: set[Key] = set()
    said: list[str] = []
    for one in _members(look):
        key = one.term.key
        if correction := _correction(look, one):
            said.append(correction)
            kept.add(key)
        elif isinstance(key, Block):
            worth = _worth(look, one.number, reporting)
            if worth > REMAINS and look.decision.probability.get(key, 0.0) > 0.5:
                other.append(Left(worth, one.term.words, one.number))
        elif key in look.decision.names and one.term.law is not None and one.is_sure:
            law = one.term.law(one.size)
            if not is_worth_a_name(look.around.scene.arm, law):
                continue
            if against := _against(look, one, reporting):
                said.append(f"{against.words}: not named")
                other += [against] if abs(against.worth) > REMAINS else []
                continue
            laws[key], departs[key], spread[key] = law, one.departure, _of_values(one)
            kept.add(key)
    said += [
        f"{key} helps the runs that decide, but not those held out: not taken into account" for key in harming
    ]
    other += _contested(look, reporting)
    sets = tuple(names for names in look.decision.ambiguous if _is_material(look, names))
    left_over = _remainder(look, other, reporting)
    unknown = _unknown(look, other, kept)
    return Judged(
        laws, spread, departs, sets, unknown, left_over, frozenset(kept), tuple(harming), tuple(said)
    )


def _correction(look: Look, one: Member) -> str:
    """When camera or currents are read is no effect of the arm: said, and taken off."""
    if one.term.words == CAMERA:
        time_ms = 1e3 * float(one.size[0]) * one.term.size
        way = "late" if time_ms < 0.0 else "early"
        return f"the camera's times are {abs(time_ms):.2f} ms {way}: taken into account"
    if isinstance(one.term.key, EffectName) and one.term.key.effect == SAMPLING and one.term.law is not None:
        # as the refit has it; beside what is always there, a command that is late by as little says the same
        time_ms = 1e3 * look.around.found.get(one.term.key, one.term.law(one.size)).values[0]
        if THINNED[0] < 1e-3 * time_ms * look.around.scene.recording.filters.rate_Hz < THINNED[1]:
            return (
                "other voltages were held between these samples, half a sample away on the whole: was the log thinned out? Taken"
                " into account; record every sample"
            )
        than = (
            "after the voltage of their line took effect"
            if look.around.scene.recording.has_voltage
            else "before the end of a step of the voltage"
        )
        return f"angles and currents are read {time_ms:.2f} ms {than}: taken into account"
    return ""


def _against(look: Look, one: Member, reporting: Picked) -> Left | None:
    """Why a name cannot stand, if it cannot."""
    name, worth = one.term.key, _worth(look, one.number, reporting)
    rival = name if isinstance(name, EffectName) else None
    # Every gear has friction: what departs from Coulomb's or the viscous law is that friction all the same.
    if one.departure > LAW_MOST and not one.term.is_common:
        return Left(worth, f"what {name} would explain departs too far from its law", one.number, rival)
    if worth < 0.0:
        return Left(worth, f"{name} helps the runs that decide, but not those held out", one.number, rival)
    return None


def _contested(look: Look, reporting: Picked) -> Iterator[Left]:
    """Names of the best set in whose place something nameless may stand."""
    for group in look.decision.remainders:
        blocks = [key for key in group if isinstance(key, Block)]
        for number in look.numbers:
            key = look.linear.terms[number].key
            if key in group and isinstance(key, EffectName):
                words = next(one.words for one in look.linear.terms if one.key == blocks[0])
                worth = _worth(look, number, reporting)
                if worth > REMAINS:
                    yield Left(worth, f"{words}, or {key}", number, key)


def _of_values(one: Member) -> Array:
    """Covariance of a law's values from that of all its coefficients."""
    assert one.term.law is not None
    here = np.array(one.term.law(one.size).values)
    slopes = []
    step = 1e-3 * max(abs(float(one.size[0])), 1e-6)
    for k in range(len(one.size)):
        moved = one.size.copy()
        moved[k] += step
        slopes.append((np.array(one.term.law(moved).values) - here) / step)
    across = np.array(slopes).T
    return np.asarray(across @ one.covariance @ across.T)


def _worth(look: Look, number: int, reporting: Picked) -> float:
    """By how much the squared gap of a cell grows on the rows kept apart, at most, without a term; negative where it shrinks."""
    return _grown(look, left(look, look.numbers, [number]), left(look, look.numbers), reporting)


def _grown(look: Look, rest: Array, whole: Array, reporting: Picked) -> float:
    """By how much the squared gap of a cell is larger with `rest` than with `whole`, on the rows kept apart, at most."""
    grown = []
    for cell in look.around.scene.cells:
        picked = reporting[cell.rows]
        if picked.any():
            grown.append(float(np.mean(rest[cell.rows][picked] ** 2 - whole[cell.rows][picked] ** 2)))
    return max(grown, key=abs, default=0.0)


def what_is_left(look: Look, keys: Collection[Key]) -> Array:
    """What these leave of all rows beside how what is known departs, as estimated beside all that was found, (rows,)."""
    drop = [k for k in look.numbers if look.linear.terms[k].key not in keys]
    return left(look, look.numbers, drop)


def _unknown(look: Look, other: Sequence[Left], kept: Collection[Key]) -> Unknown | None:
    """The largest of what is left."""
    if not other:
        return None
    one = max(other, key=lambda one: one.worth)
    nearest, share = _nearest(look, kept)
    return Unknown(one.words, one.rival or nearest, round(share, 3))


def _nearest(look: Look, kept: Collection[Key]) -> tuple[EffectName | None, float]:
    """The effect that is not named and explains most beside the names, and its share of what these leave."""
    evidence, best, terms = look.evidence, look.best, look.linear.terms
    named = tuple(one for one in best.members if terms[one[0]].key in kept)
    added = evidence.added(named, best.kappa)
    others = [
        k
        for k, one in enumerate(terms)
        if isinstance(one.key, EffectName) and one.key.effect in EFFECTS and one.key not in kept
    ]
    if not others:
        return None, 0.0
    top = max(others, key=lambda k: float(added.log[k]))
    alone = left_with(evidence, dataclasses.replace(best, members=named))
    excess = alone - left_with(evidence, best)
    at = np.concatenate([np.zeros(0, np.intp), *(evidence.places[number] for number, _ in named)])
    law = evidence.places[top][: terms[top].laws]  # without departures, which could bend it to anything
    seen, pull = evidence.gram.tip, evidence.gram.pull
    taken = np.linalg.lstsq(
        seen[np.ix_(at, at)], np.column_stack((seen[np.ix_(at, law)], pull[at])), rcond=None
    )[0]
    own = seen[np.ix_(law, law)] - seen[np.ix_(law, at)] @ taken[:, :-1]
    drawn = pull[law] - seen[np.ix_(law, at)] @ taken[:, -1]
    explained = float(drawn @ np.linalg.lstsq(own, drawn, rcond=None)[0])
    key = terms[top].key
    return (key if isinstance(key, EffectName) else None), (
        float(np.clip(explained / excess, 0.0, 1.0)) if excess > 0.0 else 0.0
    )


def _remainder(look: Look, other: Sequence[Left], reporting: Picked) -> tuple[Remainder, ...]:
    """What is left without one name, the largest first."""
    whole = left(look, look.numbers)
    scene = look.around.scene
    found = []
    for one in sorted(other, key=lambda one: -one.worth):
        if one.worth > 0.0:
            moved = left(look, look.numbers, [one.number]) - whole
            size = {
                channel: value
                for channel, value in in_si(moved, scene.rows.table, reporting, scene.arm).items()
                if value > 0.0
            }
            found.append(Remainder(one.words, _share(look, one.number), size))
    return tuple(found)


def _share(look: Look, number: int) -> float:
    """Of the excess of all rows that decide over what the best set leaves, what a term explains."""
    whole = left_with(look.evidence, look.best)
    excess = look.evidence.gram.left - whole
    rest = dataclasses.replace(look.best, members=tuple(one for one in look.best.members if one[0] != number))
    return (
        float(np.clip((left_with(look.evidence, rest) - whole) / excess, 0.0, 1.0)) if excess > 0.0 else 0.0
    )


def _is_material(look: Look, names: Sequence[EffectName]) -> bool:
    """Whether one of a set, as it is in the best set, is of a size worth a name."""
    laws = look.laws()
    return any(name in laws and is_worth_a_name(look.around.scene.arm, laws[name]) for name in names)


def stages(look: Look, told: Judged, reporting: Picked) -> tuple[NamedEffect, ...]:
    """Names by what each explains, with the gap as they come in."""
    numbers = {look.linear.terms[k].key: k for k in look.numbers}
    table = look.around.scene.rows.table
    share = {name: _share(look, numbers[name]) for name in told.laws}
    corrected = [key for key in told.kept if key not in told.laws]
    found: list[NamedEffect] = []
    for name in sorted(share, key=lambda one: -share[one]):
        so_far = [*corrected, *(one.name for one in found), name]
        found.append(
            NamedEffect(
                name,
                forms.parameters(told.laws[name], told.covariance[name]),
                gap(what_is_left(look, so_far), table, reporting),
                probability=look.decision.probability[name],
                share=share[name],
                departure=told.departure[name],
                variable=look.linear.terms[numbers[name]].variable,
            )
        )
    return tuple(found)


def silent(look: Look, after: Array, reporting: Picked, harming: Sequence[Key] = ()) -> Unknown | None:
    """What is left above the floor although no block takes it: the worst cell, and the name that was withdrawn, if one was."""
    scene = look.around.scene
    rivals = [key for key in harming if isinstance(key, EffectName) and key.effect in EFFECTS]
    most = math.sqrt(1.0 + REMAINS) if rivals else SILENT_MOST
    if not reporting.any() or gap(after, scene.rows.table, reporting) < most:
        return None
    size, words = max(
        (float(np.sqrt(np.mean(after[c.rows][reporting[c.rows]] ** 2))), str(c))
        for c in scene.cells
        if reporting[c.rows].any()
    )
    return Unknown(
        f"the {words}: {size:.1f} times its noise is left, and follows nothing that was tried",
        rivals[0] if rivals else None,
        0.0,
    )


def nameable_effects(look: Look) -> tuple[Nameable, ...]:
    """Detectability of every effect's usual size, and its rivals, whatever is nominal taken as right."""
    some: dict[Key, list[int]] = {}
    for number, one in enumerate(look.linear.terms):
        if isinstance(one.key, EffectName) and one.key.effect in EFFECTS:
            some.setdefault(one.key, []).append(number)
    middle = [numbers[len(numbers) // 2] for numbers in some.values()]
    if not middle:
        return ()
    at = look.linear.at(middle)[look.linear.first :]
    evidence = Evidence(only(look.gram, at), [look.linear.terms[k] for k in middle], FLOOR_DOUBT)
    return nameable(evidence)


def next_experiment(
    recording: Recording, sets: Sequence[Sequence[EffectName]], unknown: Unknown | None
) -> str | None:
    """What to record where something is open."""
    if sets:
        return _to_separate(recording, sets[0])
    if unknown is not None:
        advice = _advice(recording, unknown.where.startswith("the tip"))
        return f"To see more of what is left ({unknown.where}), record {advice}."
    return None


def open_questions(recording: Recording, told: Judged) -> tuple[OpenQuestion, ...]:
    """One for each set and each remainder."""
    sets = [
        OpenQuestion(f"Which of {', '.join(map(str, names))} is it?", _to_separate(recording, names))
        for names in told.ambiguous
    ]
    rest = [
        OpenQuestion(
            f"What is it that shows in {one.where}?",
            f"Record {_advice(recording, one.where.startswith('the tip'))}.",
        )
        for one in told.remainder
    ]
    return (*sets, *rest)


def _to_separate(recording: Recording, names: Sequence[EffectName]) -> str:
    is_of_tip = any(name.effect in OF_THE_TIP for name in names)
    return f"To separate {', '.join(map(str, names))}, record {_advice(recording, is_of_tip)}."


def _advice(recording: Recording, is_of_tip: bool = True) -> str:
    """What these runs lack; a camera only where it would see what is asked."""
    if is_of_tip and not recording.has_tip:
        return "the same runs with the camera on the tip"
    if not recording.has_current:
        return "the same runs with the motor currents"
    loads = {round(float(np.median(run.payload_kg)), 3) for run in recording.runs}
    if len(loads) < 2:
        return "the same runs with a known payload at the tip"
    return "slow ramps and reversals at several speeds, each twice, with and without payload"
