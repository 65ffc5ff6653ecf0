"""The fit: linearise around what was found, weigh sets of effects, and again until the answer stays."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import Array
from calib.gap.effects.catalogue import comes_round, is_gear, series_of, series_terms, usual
from calib.gap.effects.record import departures
from calib.gap.finding import EffectName
from calib.gap.posterior.constants import (
    FLOOR_DOUBT,
    IMMATERIAL,
    MARGIN,
    REMAINS,
    ROUGH,
    SIZE_LEVELS,
    UNTOLD,
    SETTLED_sd,
    SURE_sd,
)
from calib.gap.posterior.decide import rivals
from calib.gap.posterior.evidence import Evidence, Weighed
from calib.gap.posterior.search import Search
from calib.gap.posterior.term import Block, Key
from calib.gap.residuals.scene import OperatingPoint, SeriesScene, SeriesTerm, scaled, stacked
from calib.gap.residuals.whitening import Noise
from calib.gap.series.blocks import ACCELERATION, blocks_of, torque_size
from calib.gap.series.linear import Marginal, SeriesFit, SeriesLinear, cross_validated, noises_of, refitted, weighed
from calib.gap.series.split import Picked, RowSplit
from calib.gap.signals.terms import Law
from calib.settling import FITS_MOST, Settling
from control.plain_text import Advance


@dataclass(frozen=True, slots=True)
class Validated:
    """A fit, and how well its best set predicts recordings that it was not fitted to.

    `noises`: what is left there, of every cell; `missed`: of each run, the logarithm of its prediction errors' variance (runs,);
    `weight`: its share of the rows (runs,); `usable`: the rows that were looked at.
    """

    fit: SeriesFit
    noises: tuple[Noise, ...]
    missed: Array
    weight: Array
    usable: Picked

    @classmethod
    def of(cls, fit: SeriesFit, split: RowSplit) -> Validated:
        """Every group of recordings predicted from the others."""
        scene, members = fit.point.scene, fit.best.members
        sd = np.concatenate([fit.evidence.scales[k][0][h] for k, h in members] or [np.zeros(0)])
        groups = [scene.picked(group & scene.usable) for group in split.groups]
        rest = cross_validated(fit.linear, fit.numbers, sd, fit.noises, groups)
        noises = noises_of(scene, rest, fit.rows)
        runs = len(scene.recording.runs)
        rows = np.array(
            [
                np.bincount(series.run[fit.rows[thin]], minlength=runs)
                for series, thin in zip(scene.series, scene.thin, strict=True)
            ]
        )
        errors = np.array([2.0 * np.log(noise.scale * noise.sd[-1]) for noise in noises])
        missed = np.sum(np.where(rows > 0, rows * errors, 0.0), axis=0) / np.maximum(rows.sum(axis=0), 1)
        return cls(fit, tuple(noises), missed, rows.sum(axis=0) / rows.sum(), scene.usable)

    def unless_worse_than(self, before: Validated | None, is_remeasured: bool = False) -> Validated:
        """This one, or the one before if that predicted better by what is worth a word.

        `is_remeasured`: it has the noise that the one before left, which is nearer to the truth whatever it predicts by chance:
        the one before must be better by more than the standard error among the runs, too.
        """
        if before is None:
            return self
        worse = float(self.weight @ self.missed - before.weight @ before.missed)
        runs = int(np.count_nonzero(self.weight))
        off = self.missed - before.missed - worse
        spread = math.sqrt(float(self.weight**2 @ off**2) * runs / max(runs - 1, 1)) if is_remeasured else 0.0
        return self if worse <= max(math.log1p(REMAINS), spread) else before


def fitted(
    scene: SeriesScene, known: Sequence[Law], split: RowSplit, names: Collection[str] | None, advance: Advance
) -> SeriesFit:
    """The last fit that predicts recordings no worse than those before it."""
    point = OperatingPoint.of(scene, known, {})
    last: Validated | None = None
    starts: list[frozenset[Key]] = []
    noises = [Noise.white(len(scene.recording.runs)) for _ in scene.cells]
    first: list[SeriesTerm] = []
    blocks = list(blocks_of(point))

    def linearised(operating_point: OperatingPoint) -> SeriesLinear:
        terms = [*series_terms(operating_point, names, first), *blocks]
        return SeriesLinear.around(operating_point, terms, tuple(nuisances(operating_point, terms)))

    seen: set[frozenset[Key]] = set()
    while True:
        turn = len(seen)
        advance("what every effect would do", _done(turn, 0.0))
        linear = linearised(point)
        first = first or list(linear.terms)
        advance("weighing effects", _done(turn, 0.25 if turn == 0 else 0.05))
        judged = Validated.of(weighed(point, linear, noises, split, starts), split)
        if seen or judged.fit.best.kappa > UNTOLD:
            again = Validated.of(weighed(point, linear, judged.noises, split, starts), split)
            judged = again.unless_worse_than(judged, is_remeasured=True)
        fit, noises = judged.fit, list(judged.noises)
        last = judged.unless_worse_than(last)
        keys = fit.names
        if last is not judged or not fit.laws() or keys in seen:
            break
        seen.add(keys)
        starts = [keys, frozenset(key for key in keys if isinstance(key, EffectName))]
        advance("settling what bends", _done(turn, 0.85))
        after = settled(fit, split)
        if np.linalg.norm(remains(after, fit)) > np.linalg.norm(remains(point, fit)):
            break  # no better point of linearisation
        point = after
    assert last is not None  # the first is taken
    scene.keep(last.usable)
    return against_rivals(last.fit, split, linearised, advance)


# Shares of all that is done at which a fit begins and ends, and of the fit what is left when each linearisation begins: two are
# enough for one answer, another takes four and rivals.
BEGUN, FITTED, COMPARED = 0.05, 0.87, 0.97
TO_GO = 1.0, 0.6, 0.25


def _done(turn: int, part: float) -> float:
    """The share that is done after a part of a linearisation, of which the first is turn 0."""

    def to_go(turn: int) -> float:
        return TO_GO[turn] if turn < len(TO_GO) else TO_GO[-1] * 0.5 ** (turn + 1 - len(TO_GO))

    return FITTED - (FITTED - BEGUN) * ((1.0 - part) * to_go(turn) + part * to_go(turn + 1))


def remains(point: OperatingPoint, fit: SeriesFit) -> Array:
    """What a model leaves of the rows that decide, each cell by its noise, (thin rows,); blocks are in no model."""
    thin = zip(point.scene.thinned, point.scene.cells, strict=True)
    residual = np.concatenate([thinned.of(point.residual[cell.rows]) for thinned, cell in thin])
    return np.asarray(fit.linear.whitened(residual[:, None], fit.noises)[fit.rows, 0])


def settled(fit: SeriesFit, split: RowSplit) -> OperatingPoint:
    """Around the best set, with its laws' values refitted until what the model leaves settles."""
    scene, known = fit.point.scene, fit.point.known

    def at(laws: Mapping[Key, Law]) -> OperatingPoint:
        scene.keep(scene.rows.resting((*known, *laws.values())))
        return OperatingPoint.of(scene, known, laws)

    point, settling = at(fit.laws()), Settling(FITS_MOST)
    while settling.goes_on and not all(law.form.is_straight for law in point.laws.values()):
        usable = scene.usable
        further = at(_refitted(fit, point, split))
        before, after = remains(point, fit), remains(further, fit)
        # what a play does to the rows bends so much that a refit may lead away
        if after @ after <= before @ before and settling.takes(float(np.linalg.norm(after - before)), SETTLED_sd):
            point = further
        else:
            scene.keep(usable)
            break
    return point


def _refitted(fit: SeriesFit, point: OperatingPoint, split: RowSplit) -> dict[Key, Law]:
    """The laws of a model one step further."""
    scene, laws = point.scene, point.laws
    blocks = [fit.linear.terms[k] for k in fit.numbers if fit.linear.terms[k].law is None]
    terms = [term for term in series_terms(point, keys=laws.keys()) if term.now is not None]
    linear = SeriesLinear.around(point, [*terms, *blocks])
    gram = linear.gram(fit.noises, scene.picked(split.deciding & scene.usable))
    sd = np.concatenate([_usual(term) for term in linear.terms])
    inner = np.eye(len(sd)) + sd[:, None] * gram.among(np.arange(len(sd)), slice(None)) * sd
    covariance = sd[:, None] * np.linalg.inv(inner) * sd
    size, first = covariance @ gram.drawn(slice(None)), 0
    moved = dict(laws)
    for term in terms:
        place = slice(first, first + term.count)
        coefficients = size[place]
        first += term.count
        if term.law is None or not isinstance(term.key, EffectName):
            continue
        if term.curve is not None:
            coefficients, _ = term.curve.held(coefficients, covariance[place, place])
        if term.is_positive and coefficients[0] <= 0.0:
            continue
        moved[term.key] = term.law(coefficients).bounded()
    return moved


def _usual(term: SeriesTerm) -> Array:
    """Standard deviations of a term that is surely there: of a large size and of the usual roughness."""
    if not term.is_name:
        return np.asarray(term.scales()[0][-1])
    rest = term.count - term.laws - term.departures
    return np.repeat((SIZE_LEVELS[-1], ROUGH, 1.0), (term.laws, term.departures, rest))


# Names that explain nearly the same rows, compared each at the operating point of its own.
#
# What a law does to the rows depends on the laws beside it: cogging follows the motor's angle, which an encoder's error
# shifts. At the operating point of one name its rival therefore lacks what the neighbours would make up for.
RIVALS_MOST = 3  # that are looked into: each costs a linearisation


def against_rivals(
    fit: SeriesFit, split: RowSplit, linearise: Callable[[OperatingPoint], SeriesLinear], advance: Advance
) -> SeriesFit:
    """The likeliest of a fit and its rivals' own; what leads by too little for a name is ambiguous with its rival."""
    scene = fit.point.scene
    near: list[tuple[EffectName, EffectName]] = []
    tried: set[frozenset[EffectName]] = set()
    for count in range(RIVALS_MOST):
        advance("rivals of what was found", FITTED + (COMPARED - FITTED) * count / RIVALS_MOST)
        if (contest := next((one for one in contests(fit) if frozenset(one[:2]) not in tried), None)) is None:
            break
        name, rival, members = contest
        tried.add(frozenset((name, rival)))
        usable = scene.usable
        point = settled(_with(fit, members), split)
        keys = frozenset(fit.linear.terms[number].key for number, _ in members.members)
        alternative = weighed(point, linearise(point), fit.noises, split, [keys])
        rows = fit.rows & alternative.rows
        lead = _log(fit, rows) - _log(alternative, rows)
        if rival not in alternative.names or name in alternative.names or lead >= MARGIN:
            scene.keep(usable)
        elif lead > 0.0:
            near.append((name, rival))
            scene.keep(usable)
        else:
            fit = alternative
            near += [(rival, name)] if lead > -MARGIN else []
    # of pairs whose name has made room for another rival nothing is left to say
    still = [(name, rival) for name, rival in near if name in fit.decision.names]
    return replace(fit, decision=fit.decision.with_sets(still))


def contests(fit: SeriesFit) -> Iterator[tuple[EffectName, EffectName, Weighed]]:
    """Each name with another that, in its place, adds nearly what it adds, and the likeliest such set."""
    for (number, _), gain in zip(fit.best.members, fit.best.gains, strict=True):
        name = fit.linear.terms[number].key
        if isinstance(name, EffectName) and name in fit.decision.names:
            for rival, members in rivals(fit.evidence, fit.sets, name, max(REMAINS * gain, MARGIN)):
                yield name, rival, members


def _with(fit: SeriesFit, members: Weighed) -> SeriesFit:
    return replace(fit, decision=replace(fit.decision, best=members))


def _log(fit: SeriesFit, rows: Picked) -> float:
    """Log posterior of a fit's best set on thin rows, that of another operating point may be compared with."""
    numbers = [number for number, term in enumerate(fit.linear.terms) if term.key in fit.names]
    linear, members = fit.linear.only(numbers), [(numbers.index(number), scale) for number, scale in fit.best.members]
    gram = Marginal.of(linear.gram(fit.noises, rows), linear.first).apart
    return Search(Evidence(gram, linear.terms, FLOOR_DOUBT)).weigh(members).log - 0.5 * gram.left


# What is never known better: integrated out of every set, so that nothing of it is taken for an effect.
#
# Nominal values are right to a part of the smallest size that is worth a name, and parts whose laws the file has depart from
# them as all real parts do. A rotor that the file does not know may take all that its motor gives: else what it takes while the
# joint accelerates looks like a soft gear, another link or another motor.
NUISANCES = Block(0, "nuisances")


def nuisances(point: OperatingPoint, terms: Sequence[SeriesTerm]) -> Iterator[SeriesTerm]:
    """Terms of prior standard deviation one.

    Of a gear that gives way a little only what the tip shows: what its link does to the currents follows the noise of the
    measured accelerations, which the residual has, too.
    """
    unknown = _unknown_rotors(point.scene)
    variants: dict[tuple[Key, str], list[SeriesTerm]] = {}
    for term in terms:
        variants.setdefault((term.key, term.words), []).append(term)
    for alternatives in variants.values():
        term = alternatives[len(alternatives) // 2]
        is_small = isinstance(term.key, EffectName) and not comes_round(term.key.effect)
        if is_small or (isinstance(term.key, Block) and term.count == 1):
            response = {
                cell: columns[:][:, : term.laws]
                for cell, columns in term.response.items()
                if not (isinstance(term.key, EffectName) and is_gear(term.key.effect)) or point.scene.cells[cell].joint < 0
            }
            effect = term.key.effect if isinstance(term.key, EffectName) else term.key.variable
            if response and term.key in unknown:
                most = float(point.scene.given_Nm[unknown[term.key]])
                yield _nuisance(term.words, scaled(response, most / torque_size(point.scene, unknown[term.key])), 1)
            elif response:
                yield _nuisance(str(term.key), scaled(response, IMMATERIAL / usual(effect)), term.laws)
    for law in point.known:
        yield from _departing(point, law)


def unknown_rotors(fit: SeriesFit) -> Iterator[str]:
    """Said of joints whose motors surely have an inertia that the file does not know."""
    scene, (size, covariance), place = fit.point.scene, refitted(fit, fit.numbers), 0
    words = {nuisance.words: nuisance.key.joint for nuisance in fit.linear.terms if nuisance.key in _unknown_rotors(scene)}
    for nuisance in fit.linear.nuisances:
        if (joint := words.get(nuisance.words)) and size[place] > SURE_sd * math.sqrt(covariance[place, place]):
            acceleration = scene.whole.acceleration[:, joint - 1]
            most = float(scene.given_Nm[joint - 1]) / float(np.sqrt(np.mean(acceleration**2)))
            value = most * float(size[place]) / scene.arm.drives[joint - 1].gear_ratio ** 2
            # to a factor of two: of the accelerations that it is told by, coarse encoders leave the slow part
            yield (
                f"drive {joint}: arm.toml knows no rotor_inertia_kg_m2, and the motor takes more torque while it accelerates, as"
                f" of some {value:.2g} kg m2: it is in no name, and stays in the gap until arm.toml has it"
            )
        place += nuisance.count


def _unknown_rotors(scene: SeriesScene) -> dict[Key, int]:
    """Blocks that stand for rotors which the file does not know, with their joint (0-based)."""
    drives = scene.arm.drives
    return {Block(drive.joint, ACCELERATION): drive.joint - 1 for drive in drives if not drive.rotor_inertia_kg_m2}


def _departing(point: OperatingPoint, law: Law) -> Iterator[SeriesTerm]:
    series = series_of(law.name.effect)
    if law.form.acts != "motor" or series is None or law.name.joint is None:
        return
    column = point.scene.split(point.scene.columns.friction_slope(law)[:, None])
    bent, _ = departures(point.scene, series.departs, law.name.joint - 1, column)
    if bent:
        columns = {cell: own[:] for cell, own in bent.items()}
        yield _nuisance(f"{law.name}, as it departs", scaled(columns, ROUGH), next(iter(bent.values())).shape[1])


def _nuisance(words: str, response: dict[int, np.ndarray], width: int) -> SeriesTerm:
    return SeriesTerm(NUISANCES, words, width, response=stacked([response]))
