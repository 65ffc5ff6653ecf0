"""The arm.toml that time series lead to: the named laws alone, identified on the runs that decide, and what the file leaves.

The posterior says which laws there are, beside departures, nuisances and blocks. None of these is in the file, so its values are
those with which the laws alone leave least, in the floors of the channels: no prior on their size, and nothing else that could
take their part. What the arm's file has already is identified with them, where the rows follow it in a straight line: no evidence
says that it is right, and the names would take what it lacks. What no file says of a recording (when camera and currents were
read) is identified beside them.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arrays import Array
from calib.gap.effects.catalogue import known_laws, other_forms
from calib.gap.finding import EffectName
from calib.gap.posterior.constants import SETTLED_sd
from calib.gap.posterior.decide import sureness_of_file
from calib.gap.residuals.rows import ResidualRows
from calib.gap.series.linear import SeriesFit, without_each
from calib.gap.series.split import Picked, RowSplit
from calib.gap.series.validation import Member, members
from calib.gap.signals.terms import Law
from calib.settling import FITS_MOST, Settling
from control.model.arm import Arm
from control.model.description import arm_text, parse_arm
from control.model.effects import EFFECTS

GROUPS_LEAST = 3  # of runs that are left out in turn, for a spread between them


@dataclass(frozen=True, slots=True)
class Identified:
    """The laws of a file: coefficients of each member's columns by number, departures nought, with their covariance; `columns` of
    all rows that they do together, and names without which the runs are predicted as well, or that come out as none; `refitted`:
    changes of what the arm's file has besides, which are no names.
    """

    size: Mapping[int, Array]
    covariance: Mapping[int, Array]
    dropped: Mapping[EffectName, str]
    refitted: tuple[Member, ...]


def identified(fit: SeriesFit, candidates: Sequence[Member], parts: RowSplit) -> Identified:
    """Least squares of the laws of members of a fit's best set on the rows that decide, without those that do not help.

    What the arm's file has of a joint gives way where a name of that joint would fall with it: they take each other's part, and
    the evidence is for the name. An arm of which nothing is named stays as it was given.
    """
    dropped: dict[EffectName, str] = {}
    names = {_name(member) for member in candidates if _is_listed(member)}
    refitted = list(_refitted(fit, names))
    while True:
        refitted = [member for member in refitted if member.term.key not in dropped and names - dropped.keys()]
        laws = _Laws.of(fit, [*refitted, *(member for member in candidates if member.term.key not in dropped)], parts)
        why = laws.against(names)
        if not why:
            size, covariance = laws.sizes(), laws.stated()
            changed = (dataclasses.replace(m, size=size[m.number], covariance=covariance[m.number]) for m in refitted)
            return Identified(size, covariance, dropped, tuple(changed))
        fallen = {name.acts_on for name in why if name in names}
        giving = {_name(member) for member in refitted if _name(member).acts_on in fallen}
        dropped |= dict.fromkeys(giving, "gives way to a name") if giving else why


def _refitted(fit: SeriesFit, names: Collection[EffectName]) -> Iterator[Member]:
    """What the arm's file has beside the names, as changes that add to it: the terms that stand for them in the search.

    What poses tell of as well is not for time series alone to settle.
    """
    told = () if fit.point.scene.told is None else fit.point.scene.told.places
    known = {law.name: law for law in fit.point.known if law.name not in names and law.name not in told}
    for number, term in enumerate(fit.linear.terms):
        stated = known.get(term.key) if isinstance(term.key, EffectName) else None
        if stated is None or term.law is None or term.curve is not None:
            continue
        nothing = term.law(np.zeros(term.count))
        if any(nothing.values) or (nothing.form, nothing.order) != (stated.form, stated.order):
            continue
        del known[stated.name]
        # a change may be below nought; how the law departs makes the file's value no other
        (member,) = members(fit, [number])
        term = dataclasses.replace(term, is_positive=False)
        yield dataclasses.replace(member, term=term, covariance=member.covariance - member.alike, alike=0.0 * member.alike)


@dataclass(frozen=True, slots=True)
class _Laws:
    """Members with `ways` (offset, directions) of their coefficients; free coefficients of all of them together, and those
    without one group of runs in turn.
    """

    members: tuple[Member, ...]
    ways: tuple[tuple[Array, Array], ...]
    places: tuple[slice, ...]
    whole: Array
    parted: Array  # (groups, c)
    bent: Mapping[int, Array]  # by number, of laws whose response bends: (groups, all their columns)
    grams: tuple[Array, ...]  # of columns and y, by group
    ridge: Array

    @classmethod
    def of(cls, fit: SeriesFit, members: Sequence[Member], parts: RowSplit) -> _Laws:
        ways = tuple(map(_ways, members))
        ends = np.cumsum([0, *(free.shape[1] for _, free in ways)]).tolist()
        places = tuple(slice(first, end) for first, end in itertools.pairwise(ends))
        table = np.zeros((len(fit.linear.y), ends[-1] + 1))
        table[:, -1] = fit.linear.y
        for member, (offset, free), place in zip(members, ways, places, strict=True):
            for cell, columns in member.term.response.items():
                rows = fit.point.scene.cells[cell].rows
                table[rows, place] += columns @ free
                table[rows, -1] -= columns @ offset
        groups = [group & fit.point.scene.usable for group in parts.groups or (parts.deciding,)]
        grams = tuple(table[group].T @ table[group] for group in groups)
        # of links and frames no motion tells everything
        ridge = np.concatenate([np.zeros(0), *(np.full(free.shape[1], free.shape[1] > 2) for _, free in ways)])
        total = np.sum(grams, axis=0)
        parted = np.array([_solved(total - gram, ridge) for gram in grams] if len(grams) > 1 else [])
        bent = _bent(fit, members, groups) if len(grams) > 1 else {}
        return cls(tuple(members), ways, places, _solved(total, ridge), parted, bent, grams, ridge)

    def sizes(self) -> dict[int, Array]:
        """By number of the term, of all its columns."""
        return {
            member.number: offset + free @ self.whole[place]
            for member, (offset, free), place in zip(self.members, self.ways, self.places, strict=True)
        }

    def covariances(self) -> dict[int, Array]:
        """The posterior's, which counts departures, or the spread between the groups of runs where that is larger."""
        by_number = {}
        for member, place in zip(self.members, self.places, strict=True):
            covariance = member.covariance.copy()
            spread = jackknife_variance(self.bent[member.number] if member.number in self.bent else self.parted[..., place])
            for k, variance in enumerate(spread.tolist()):
                factor = math.sqrt(max(1.0, variance / max(covariance[k, k], 1e-300)))
                covariance[k, :] *= factor
                covariance[:, k] *= factor
            by_number[member.number] = covariance
        return by_number

    def stated(self) -> dict[int, Array]:
        """`covariances`, with how far the file's values and the posterior's are apart: as poses have it.

        Where what the file has departs from its laws, neither of the two knows by how much it took the part of what is named:
        the posterior gives departures what they may be, the file's laws take all that is left.
        """
        stated, sizes = self.covariances(), self.sizes()
        for member in self.members:
            laws = slice(0, member.term.laws)
            apart = sizes[member.number][laws] - member.size[laws]
            stated[member.number][laws, laws] += np.outer(apart, apart)
        return stated

    def against(self, names: Collection[EffectName]) -> dict[EffectName, str]:
        """The effect that stands least, if one does not, and why: a name that may be none, a value without which the runs are
        predicted as well.
        """
        covariance = self.covariances()
        worst: dict[EffectName, float] = {}
        needed: dict[EffectName, float] = {}
        for member, place in zip(self.members, self.places, strict=True):
            if not _is_listed(member) or place.start == place.stop:
                continue
            needed[_name(member)] = self._missed(place)
            size, laws = self.whole[place], slice(0, place.stop - place.start)
            far = sureness_of_file(size, member.size[laws], covariance[member.number][laws, laws])
            if _name(member) in names and ((member.term.is_positive and size[0] < member.term.least) or far < 1.0):
                worst[_name(member)] = far if size[0] > 0.0 else -far
        if worst:
            return {min(worst, key=lambda key: worst[key]): "may as well be none, identified with what else is named"}
        least = min(needed, key=lambda key: needed[key], default=None)
        if least is not None and needed[least] <= self._missed(slice(0, 0)):
            return {least: "is not needed: without it the runs are predicted as well"}
        return {}

    def _missed(self, drop: slice) -> float:
        """Sum of squares of every group of runs as the others predict it, without the columns `drop`."""
        if len(self.grams) < 2:
            return math.inf if drop.stop > drop.start else 0.0
        keep = np.delete(np.arange(len(self.whole) + 1), np.arange(drop.start, drop.stop))
        total, missed = np.sum(self.grams, axis=0), 0.0
        for gram in self.grams:
            across = np.ix_(keep, keep)
            size = np.append(-_solved((total - gram)[across], self.ridge[keep[:-1]]), 1.0)
            missed += float(size @ gram[across] @ size)
        return missed


def _bent(fit: SeriesFit, members: Sequence[Member], groups: Sequence[Picked]) -> dict[int, Array]:
    """Coefficients of laws whose response bends, as the posterior has them without one group of runs in turn."""
    curved = {member.number for member in members if member.term.curve is not None}
    by_number: dict[int, Array] = {}
    if not curved:
        return by_number
    parted, first = without_each(fit, groups), fit.linear.first
    for number in fit.numbers:
        count = fit.linear.terms[number].count
        if number in curved:
            by_number[number] = parted[:, first : first + count]
        first += count
    return by_number


def jackknife_variance(parted: Array) -> Array:
    """Variance (c,) by values without one group of runs in turn, (groups, c); none where groups are few."""
    groups = len(parted)
    if groups < GROUPS_LEAST:
        return np.zeros(parted.shape[-1])
    return np.asarray((groups - 1) * np.var(parted, axis=0))


def _is_listed(member: Member) -> bool:
    """Whether it is an effect, and nothing of the sensors."""
    return isinstance(member.term.key, EffectName) and member.term.key.effect in EFFECTS


def _name(member: Member) -> EffectName:
    assert isinstance(member.term.key, EffectName)
    return member.term.key


def _solved(gram: Array, ridge: Array) -> Array:
    """Coefficients of all columns but the last, which they add up to."""
    inner = gram[:-1, :-1] + np.diag(ridge)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(inner), 1e-300))
    return np.asarray(scale * np.linalg.lstsq(scale[:, None] * inner * scale, scale * gram[:-1, -1], rcond=1e-10)[0])


def _ways(member: Member) -> tuple[Array, Array]:
    """A member's coefficients without departures as an offset (c,) and directions (c, f) that are free.

    A law whose response bends stays as large as the posterior has it; what turns with another's size keeps its share.
    """
    size = member.size.copy()
    size[member.term.laws : member.term.laws + member.term.departures] = 0.0
    if member.term.curve is not None:
        return size, np.zeros((len(size), 0))
    if member.term.laws == 1 and size[0]:
        return np.zeros(len(size)), size[:, None] / size[0]
    return np.zeros(len(size)), np.eye(len(size))[:, : member.term.laws]


def with_least_left(
    left_by: Callable[[Mapping[EffectName, Law]], Array], laws: Mapping[EffectName, Law], sd: Mapping[EffectName, Array]
) -> dict[EffectName, Law]:
    """Laws of a file with those sizes of the ones in `sd` with which they leave least, `left_by` laws: (rows,).

    A linearisation knows a law that bends around one size alone, and what a late command does jumps at whole samples. So what is
    left within three standard deviations is looked at, before Gauss and Newton's steps lead on from the best of it.
    """
    ways = [(name, place) for name in sd for place in range(laws[name].form.counted or len(laws[name].values))]
    small = np.array([dict(enumerate(step for _, step in laws[name].neighbours()))[place] for name, place in ways])

    def with_sizes(x: Array) -> dict[EffectName, Law]:
        model = dict(laws)
        for (name, place), value in zip(ways, x.tolist(), strict=True):
            values = (*model[name].values[:place], value, *model[name].values[place + 1 :])
            model[name] = model[name].at(values).bounded()
        return model

    def left(x: Array) -> Array:
        return left_by(with_sizes(x))

    x = np.array([laws[name].values[place] for name, place in ways])
    here, every = left(x), np.eye(len(x))
    for k, (name, place) in enumerate(ways):
        if place == 0 and not laws[name].form.is_straight:
            near = [x + far * sd[name][0] * every[k] for far in (-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0)]
            here, x = min(((left(size), size) for size in near), key=lambda one: float(one[0] @ one[0]))
    settling = Settling(FITS_MOST)
    while settling.goes_on:
        slopes = np.array([(left(x + step) - here) / step.sum() for step in np.diag(small)]).T
        size = np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
        step = -np.linalg.lstsq(slopes / size, here)[0] / size
        tried = ((left(x + share * step), x + share * step) for share in (1.0, 0.5, 0.25))
        better = next((one for one in tried if one[0] @ one[0] < here @ here), (here, x))
        settling.takes(float(np.linalg.norm(better[0] - here)), SETTLED_sd)
        here, x = better
    return with_sizes(x)


def in_best_forms(rows: ResidualRows, laws: Sequence[Law], deciding: Picked) -> list[Law]:
    """Each law in the form that leaves least of the rows that decide: arm.toml does not say in which of them a part keeps it."""
    model = list(laws)
    for place, law in enumerate(laws):
        candidate = model.copy()
        least = float(np.linalg.norm(rows.residual(candidate)[deciding])) if other_forms(law) else 0.0
        for form in other_forms(law):
            candidate[place] = form
            if (remaining := float(np.linalg.norm(rows.residual(candidate)[deciding]))) < least:
                least, model[place] = remaining, form
    return model


def read_back(arm: Arm) -> Arm:
    """The arm as whoever starts it reads it."""
    return dataclasses.replace(parse_arm(arm_text(arm), Path(f"{arm.name}.toml")), path=arm.path)


def laws_of(rows: ResidualRows, arm: Arm, deciding: Picked) -> dict[EffectName, Law]:
    """What an arm's file says of time series, by name."""
    return {law.name: law for law in in_best_forms(rows, known_laws(arm), deciding)}
