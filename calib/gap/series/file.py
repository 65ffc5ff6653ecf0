"""The arm.toml that time series lead to: the named laws alone, identified on the runs that decide, and what the file leaves.

The posterior says which laws there are, beside departures, nuisances and blocks. None of these is in the file, so its values are
those with which the laws alone leave least, in the floors of the channels: no prior on their size, and nothing else that could
take their part. What no file says of a recording (when camera and currents were read) is identified beside them.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arrays import Array
from calib.gap.effects.catalogue import known_laws, other_forms
from calib.gap.finding import EffectName
from calib.gap.residuals.rows import ResidualRows
from calib.gap.series.linear import SeriesFit, without_each
from calib.gap.series.split import Picked, RowSplit
from calib.gap.series.validation import Member
from calib.gap.signals.terms import Law
from control.model.arm import Arm
from control.model.description import arm_text, parse_arm
from control.model.effects import EFFECTS

INTERVAL_sd = 1.96  # of a value: a name whose 95 % interval holds nought is none
GROUPS_LEAST = 3  # of runs that are left out in turn, for a spread between them


@dataclass(frozen=True, slots=True)
class Identified:
    """The laws of a file: coefficients of each member's columns by number, departures nought, with their covariance; `columns` of
    all rows that they do together, and names without which the runs are predicted as well, or that come out as none.
    """

    size: Mapping[int, Array]
    covariance: Mapping[int, Array]
    dropped: Mapping[EffectName, str]


def identified(fit: SeriesFit, some: Sequence[Member], parts: RowSplit) -> Identified:
    """Least squares of the laws of members of a fit's best set on the rows that decide, without those that do not help."""
    dropped: dict[EffectName, str] = {}
    while True:
        found = _Laws.of(fit, [one for one in some if one.term.key not in dropped], parts)
        why = found.against()
        if not why:
            return Identified(found.sizes(), found.stated(), dropped)
        dropped |= why


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
    def of(cls, fit: SeriesFit, some: Sequence[Member], parts: RowSplit) -> _Laws:
        ways = tuple(map(_ways, some))
        ends = np.cumsum([0, *(free.shape[1] for _, free in ways)]).tolist()
        places = tuple(slice(first, end) for first, end in itertools.pairwise(ends))
        table = np.zeros((len(fit.linear.y), ends[-1] + 1))
        table[:, -1] = fit.linear.y
        for one, (offset, free), place in zip(some, ways, places, strict=True):
            for cell, own in one.term.response.items():
                rows = fit.around.scene.cells[cell].rows
                table[rows, place] += own @ free
                table[rows, -1] -= own @ offset
        groups = [group & fit.around.scene.kept for group in parts.groups or (parts.deciding,)]
        grams = tuple(table[group].T @ table[group] for group in groups)
        # of links and frames no motion tells everything
        ridge = np.concatenate([np.zeros(0), *(np.full(free.shape[1], free.shape[1] > 2) for _, free in ways)])
        total = np.sum(grams, axis=0)
        parted = np.array([_solved(total - own, ridge) for own in grams] if len(grams) > 1 else [])
        bent = _bent(fit, some, groups) if len(grams) > 1 else {}
        return cls(tuple(some), ways, places, _solved(total, ridge), parted, bent, grams, ridge)

    def sizes(self) -> dict[int, Array]:
        """By number of the term, of all its columns."""
        return {
            one.number: offset + free @ self.whole[place]
            for one, (offset, free), place in zip(self.members, self.ways, self.places, strict=True)
        }

    def covariances(self) -> dict[int, Array]:
        """The posterior's, which counts departures, or the spread between the groups of runs where that is larger."""
        found = {}
        for one, place in zip(self.members, self.places, strict=True):
            covariance = one.covariance.copy()
            spread = jackknife_variance(self.bent[one.number] if one.number in self.bent else self.parted[..., place])
            for k, variance in enumerate(spread.tolist()):
                factor = math.sqrt(max(1.0, variance / max(covariance[k, k], 1e-300)))
                covariance[k, :] *= factor
                covariance[:, k] *= factor
            found[one.number] = covariance
        return found

    def stated(self) -> dict[int, Array]:
        """`covariances`, with how far the file's values and the posterior's are apart: as poses have it.

        Where what the file has departs from its laws, neither of the two knows by how much it took the part of what is named:
        the posterior gives departures what they may be, the file's laws take all that is left.
        """
        found, sizes = self.covariances(), self.sizes()
        for one in self.members:
            apart = sizes[one.number][: one.term.laws] - one.size[: one.term.laws]
            found[one.number][: len(apart), : len(apart)] += np.outer(apart, apart)
        return found

    def against(self) -> dict[EffectName, str]:
        """The name that stands least, if one does not, and why."""
        covariance = self.covariances()
        worst: dict[EffectName, tuple[float, str]] = {}
        for one, place in zip(self.members, self.places, strict=True):
            if not _is_listed(one) or place.start == place.stop:
                continue
            own, sd = self.whole[place], np.sqrt(np.diag(covariance[one.number])[: place.stop - place.start])
            far = float(np.linalg.norm(own / np.maximum(sd, 1e-300)))
            if (one.term.is_positive and own[0] < one.term.least) or far < INTERVAL_sd:
                worst[_name(one)] = (far if own[0] > 0.0 else -far, "may as well be none, identified with what else is named")
        if worst:
            name = min(worst, key=lambda key: worst[key][0])
            return {name: worst[name][1]}
        missed = self._missed(slice(0, 0))
        for one, place in zip(self.members, self.places, strict=True):
            if _is_listed(one) and place.start < place.stop and self._missed(place) <= missed:
                return {_name(one): "is not needed: without it the runs are predicted as well"}
        return {}

    def _missed(self, drop: slice) -> float:
        """Sum of squares of every group of runs as the others predict it, without the columns `drop`."""
        if len(self.grams) < 2:
            return math.inf if drop.stop > drop.start else 0.0
        keep = np.delete(np.arange(len(self.whole) + 1), np.arange(drop.start, drop.stop))
        total, missed = np.sum(self.grams, axis=0), 0.0
        for own in self.grams:
            across = np.ix_(keep, keep)
            size = np.append(-_solved((total - own)[across], self.ridge[keep[:-1]]), 1.0)
            missed += float(size @ own[across] @ size)
        return missed


def _bent(fit: SeriesFit, some: Sequence[Member], groups: Sequence[Picked]) -> dict[int, Array]:
    """Coefficients of laws whose response bends, as the posterior has them without one group of runs in turn."""
    curved = {one.number for one in some if one.term.curve is not None}
    found: dict[int, Array] = {}
    if not curved:
        return found
    parted, first = without_each(fit, groups), fit.linear.first
    for number in fit.numbers:
        count = fit.linear.terms[number].count
        if number in curved:
            found[number] = parted[:, first : first + count]
        first += count
    return found


def jackknife_variance(parted: Array) -> Array:
    """Variance (c,) by values without one group of runs in turn, (groups, c); none where groups are few."""
    groups = len(parted)
    if groups < GROUPS_LEAST:
        return np.zeros(parted.shape[-1])
    return np.asarray((groups - 1) * np.var(parted, axis=0))


def _is_listed(one: Member) -> bool:
    """Whether it is an effect, and nothing of the sensors."""
    return isinstance(one.term.key, EffectName) and one.term.key.effect in EFFECTS


def _name(one: Member) -> EffectName:
    assert isinstance(one.term.key, EffectName)
    return one.term.key


def _solved(gram: Array, ridge: Array) -> Array:
    """Coefficients of all columns but the last, which they add up to."""
    inner = gram[:-1, :-1] + np.diag(ridge)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(inner), 1e-300))
    return np.asarray(scale * np.linalg.lstsq(scale[:, None] * inner * scale, scale * gram[:-1, -1], rcond=1e-10)[0])


def _ways(one: Member) -> tuple[Array, Array]:
    """A member's coefficients without departures as an offset (c,) and directions (c, f) that are free.

    A law whose response bends stays as large as the posterior has it; what turns with another's size keeps its share.
    """
    size = one.size.copy()
    size[one.term.laws : one.term.laws + one.term.departures] = 0.0
    if one.term.curve is not None:
        return size, np.zeros((len(size), 0))
    if one.term.laws == 1 and size[0]:
        return np.zeros(len(size)), size[:, None] / size[0]
    return np.zeros(len(size)), np.eye(len(size))[:, : one.term.laws]


def in_best_forms(rows: ResidualRows, laws: Sequence[Law], deciding: Picked) -> list[Law]:
    """Each law in the form that leaves least of the rows that decide: arm.toml does not say in which of them a part keeps it."""
    model = list(laws)
    for place, law in enumerate(laws):
        kept = model.copy()
        least = float(np.linalg.norm(rows.residual(kept)[deciding])) if other_forms(law) else 0.0
        for other in other_forms(law):
            kept[place] = other
            if (left := float(np.linalg.norm(rows.residual(kept)[deciding]))) < least:
                least, model[place] = left, other
    return model


def read_back(arm: Arm) -> Arm:
    """The arm as whoever starts it reads it."""
    return dataclasses.replace(parse_arm(arm_text(arm), Path(f"{arm.name}.toml")), path=arm.path)


def laws_of(rows: ResidualRows, arm: Arm, deciding: Picked) -> dict[EffectName, Law]:
    """What an arm's file says of time series, by name."""
    return {law.name: law for law in in_best_forms(rows, known_laws(arm), deciding)}
