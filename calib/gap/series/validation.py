"""What of the best set stands: on runs that were not fitted, and beside what is left without a name."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.effects.catalogue import series_of
from calib.gap.finding import EffectName
from calib.gap.posterior.constants import CREDIBLE_LEAST, GROWS, LAW_MOST, REMAINS, SURE_sd
from calib.gap.posterior.decide import is_exact
from calib.gap.posterior.term import Block, Key
from calib.gap.residuals.scene import SeriesTerm
from calib.gap.series.blocks import CAMERA
from calib.gap.series.linear import SeriesFit, residual_of
from calib.gap.series.outcome import gap
from calib.gap.series.split import Picked


@dataclass(frozen=True, slots=True)
class Member:
    """A term of the best set by number, with its coefficients and their covariance; `alike`: the part of it that departures bring
    which look like the law itself.
    """

    number: int
    term: SeriesTerm
    size: Array
    covariance: Array
    alike: Array

    @property
    def is_sure(self) -> bool:
        """Whether its law is not nothing; what every gear has need not be far from it."""
        if self.term.is_common:
            return True
        laws = slice(0, self.term.laws)
        sd = np.sqrt(np.diag(self.covariance)[laws])
        return bool(np.linalg.norm(self.size[laws] / sd) >= SURE_sd)

    @property
    def departure(self) -> float:
        """What its departures do, over what its law does."""
        return self.term.departed_by(self.size)


def members(fit: SeriesFit, numbers: Sequence[int] | None = None) -> Iterator[Member]:
    """Each averaged over how large it and its departures may be, all others at their best; `numbers`: terms beside the best set.

    An exact law is left out of that where a law may depart: an interval holds only if it counts departures that do not show.
    """
    evidence, best = fit.evidence, fit.best
    for number in fit.numbers if numbers is None else numbers:
        rest = [entry for entry in best.members if entry[0] != number]
        term = fit.linear.terms[number]
        scales = [h for h in range(len(evidence.weights[number])) if not is_exact(evidence, number, h)]
        ways = [[*rest, (number, scale)] for scale in scales]
        logs = np.array([evidence.value(way, best.kappa) for way in ways])
        share = np.exp(logs - logs.max())
        share /= share.sum()
        at = slice(-term.count, None)
        estimates = [
            (weight, *evidence.estimate(way, best.kappa))
            for weight, way in zip(share.tolist(), ways, strict=True)
            if weight > CREDIBLE_LEAST
        ]
        mean = np.asarray(sum((weight * size[at] for weight, size, _ in estimates), np.zeros(1)))
        covariance = sum(
            (weight * (spread[at, at] + np.outer(size[at] - mean, size[at] - mean)) for weight, size, spread in estimates),
            np.zeros((1, 1)),
        )
        sd = evidence.scales[number][0][scales]
        departs = share @ (sd[:, term.laws] / sd[:, 0]) ** 2 if term.departures else 0.0
        if term.curve is not None:
            mean, covariance = term.curve.held(mean, np.asarray(covariance))
        alike = departs * _alike(fit, term, mean)
        yield Member(number, term, mean, np.asarray(covariance) + alike, alike)


def _alike(fit: SeriesFit, term: SeriesTerm, size: Array) -> Array:
    """Covariance that departures as large as the law give its coefficients, as far as no data tell them from the law.

    What the arm's file has of the same law departs with it.
    """
    whole = size[: term.laws].copy()
    if term.laws == 1 and term.law is not None:
        law = term.law(np.eye(term.count)[0])
        known = sum(stated.values[0] for stated in fit.point.known if stated.name == term.key and stated.form is law.form)
        whole[0] += known / law.values[0]
    result = np.zeros((term.count, term.count))
    for shape in term.alike:
        moved = shape @ whole
        result[: term.laws, : term.laws] += np.outer(moved, moved)
    return result


def with_only(fit: SeriesFit, names: Collection[int]) -> SeriesFit:
    """The fit with the best set's blocks and these of its other terms."""
    terms = fit.linear.terms
    remaining = tuple(entry for entry in fit.best.members if entry[0] in names or isinstance(terms[entry[0]].key, Block))
    best = dataclasses.replace(fit.best, members=remaining)
    return dataclasses.replace(fit, decision=dataclasses.replace(fit.decision, best=best))


def validated(fit: SeriesFit, reporting: Picked) -> tuple[SeriesFit, list[Key]]:
    """The fit whose best set is estimated without blocks that do not help the runs kept apart, and the names that harm them.

    Blocks are tried beside names that do no harm by themselves.
    """
    table, terms = fit.point.scene.rows.table, fit.linear.terms
    blocks = [k for k in fit.numbers if isinstance(terms[k].key, Block) and terms[k].words != CAMERA]
    names = [k for k in fit.numbers if k not in blocks]
    sound = _harmless(fit, names, reporting)
    helping: list[int] = []
    while left_over := [k for k in blocks if k not in helping]:
        here = residual_of(fit, [*sound, *helping])
        tried = {k: residual_of(fit, [*sound, *helping, k]) for k in left_over}
        best = min(left_over, key=lambda k: gap(tried[k], table, reporting))
        if grown(fit, here, tried[best], reporting) <= REMAINS:
            break
        helping.append(best)
    members = tuple(entry for entry in fit.best.members if entry[0] in (*sound, *helping))
    best_set = dataclasses.replace(fit.best, members=members)
    harming = [terms[k].key for k in names if k not in sound]
    return dataclasses.replace(fit, decision=dataclasses.replace(fit.decision, best=best_set)), harming


def _harmless(fit: SeriesFit, numbers: Sequence[int], reporting: Picked) -> list[int]:
    """Those without which the gap on the runs kept apart does not shrink, each time estimated again."""
    table, sound = fit.point.scene.rows.table, list(numbers)
    while sound:
        size = gap(residual_of(fit, sound), table, reporting)
        without = {k: gap(residual_of(fit, [number for number in sound if number != k]), table, reporting) for k in sound}
        worst = min(sound, key=lambda k: without[k])
        if not without[worst] ** 2 < (1.0 - GROWS) * size**2:
            break
        sound.remove(worst)
    return sound


def dominant_names(fit: SeriesFit, names: Sequence[int], corrected: Sequence[int], reporting: Picked) -> list[int]:
    """Names that explain more than is left without a name, in the channels where they show, on the runs kept apart.

    What has no name casts shadows: of a dozen laws of a joint one always takes a part of it. So the largest of all is known.
    """
    by_number = {member.number: member for member in members(fit)}
    blocks = [k for k in by_number if isinstance(by_number[k].term.key, Block) and k not in corrected]
    # every gear has these frictions: they are no shadows
    gears = [k for k in names if by_number[k].term.is_common]
    stands = list(names)
    while stands:
        nameless = [k for k in blocks if bends(fit, by_number[k], [by_number[name] for name in stands])[0] is None]
        whole = residual_of(fit, [*stands, *corrected, *blocks], nameless)
        ratios = {}
        for k in stands:
            if k in gears:
                ratios[k] = np.inf
                continue
            rest = [*(name for name in stands if name != k), *corrected, *blocks]
            ratios[k] = _explained_over_remainder(fit, by_number[k], residual_of(fit, rest, nameless), whole, reporting)
        least = min(stands, key=lambda k: ratios[k])
        if ratios[least] >= 1.0:
            break
        stands.remove(least)
    return stands


def _explained_over_remainder(fit: SeriesFit, member: Member, without: Array, whole: Array, reporting: Picked) -> float:
    """What a term explains over what is left above the noise in the channels that it moves, each as it moves them.

    On the rows `reporting`, or on all where it hardly moves those: they do not speak of it.
    """
    if _strongest(fit, member, reporting) < REMAINS * _strongest(fit, member, ~reporting):
        reporting = np.ones_like(reporting)
    explained, remains, moved = [], [], []
    for cell, columns in member.term.response.items():
        rows = fit.point.scene.cells[cell].rows
        picked = reporting[rows]
        if picked.any():
            effect = (columns @ member.size)[picked]
            size, beside, signal = (float(np.mean(part**2)) for part in (whole[rows][picked], without[rows][picked], effect))
            explained.append(beside - size)
            remains.append(max(size - 1.0, GROWS))
            moved.append(signal)
    most = max(moved, default=0.0)
    if most <= 0.0:
        return 0.0
    return sum(explained) / sum(rest * signal / most for rest, signal in zip(remains, moved, strict=True))


def _strongest(fit: SeriesFit, member: Member, picked: Picked) -> float:
    """Mean square of what a term does to the rows picked, in the channel that it moves most there [noise variances]."""
    squares = [0.0]
    for cell, columns in member.term.response.items():
        here = (columns @ member.size)[picked[fit.point.scene.cells[cell].rows]]
        if len(here):
            squares.append(float(np.mean(here**2)))
    return max(squares)


def grown(fit: SeriesFit, rest: Array, whole: Array, reporting: Picked) -> float:
    """By how much the squared gap of a cell is larger with `rest` than with `whole`, on the rows kept apart, at most."""
    growths = []
    for cell in fit.point.scene.cells:
        picked = reporting[cell.rows]
        if picked.any():
            growths.append(float(np.mean(rest[cell.rows][picked] ** 2 - whole[cell.rows][picked] ** 2)))
    return max(growths, key=abs, default=0.0)


def bends(fit: SeriesFit, block: Member, names: Sequence[Member]) -> tuple[EffectName | None, float]:
    """The law that a block bends in its own variable, no more than real parts do, and by what share of it."""
    for member in names:
        key, block_key = member.term.key, block.term.key
        if not isinstance(key, EffectName) or not isinstance(block_key, Block) or block_key.joint != key.acts_on:
            continue
        series = series_of(key.effect)
        if series is None or block_key.variable not in series.blocks:
            continue
        law = _moved(fit, member, member.term.laws, block.term.response)
        share = _moved(fit, block, block.term.count, block.term.response) / law if law > 0.0 else np.inf
        if share <= LAW_MOST:
            return key, share
    return None, 0.0


def _moved(fit: SeriesFit, member: Member, count: int, cells: Collection[int]) -> float:
    """Root of the sum of squares of what a member's first columns do to the rows of cells."""
    parts = [member.term.response[cell][:][:, :count] @ member.size[:count] for cell in cells if cell in member.term.response]
    return float(np.sqrt(sum(float(part @ part) for part in parts)))
