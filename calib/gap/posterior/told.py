"""What recordings of one sort tell of the arm's effects to the search in those of another: their Gram matrices add.

Poses and time series are independent given the arm. Around its best set, one of them knows of the linear unknowns v that both
have (a scale, a width, a compliance: `LinearForm` of the effect) the quadratic form
  ln p(y | v) = -v' I v / 2 + v' h + constant,
  I = A_ss - A_sp (A_pp + V_p^-1)^-1 A_ps,   h = b_s - A_sp (A_pp + V_p^-1)^-1 b_p    (Schur's complement),
with A and b its Gram matrix and pull, s the columns of the laws, and p all that is its own: blocks, departures, other effects, of
prior variance V_p; its geometry or nuisances are integrated out already. The other search adds I and h to its own, so that each
set of effects is weighed with all that was recorded, and what one of them alone cannot tell apart the other does.
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.finding import EffectName
from calib.gap.posterior.constants import ROUGH, SURE_sd
from calib.gap.posterior.decide import sureness
from calib.gap.posterior.evidence import Evidence, Gram, Places, Weighed
from calib.gap.posterior.term import Key, Term, parameters_of
from control.model.arm import Arm
from control.model.effects import linear_values


@dataclass(frozen=True, slots=True)
class Told:
    """Information (k, k) and pull (k,) of the linear unknowns, in SI units, of effects by name at `places`; values are totals.

    `size` (k,): the usual one of each; `found`: those that these recordings have in their own best set.
    """

    places: Mapping[EffectName, Places]
    information: Array
    pull: Array
    size: Array
    found: frozenset[EffectName] = frozenset()

    @classmethod
    def by(
        cls,
        evidence: Evidence,
        best: Weighed,
        effects: Sequence[str],
        before: Told | None = None,
        withdrawn: Collection[Key] = (),
    ) -> Told:
        """By the evidence around its best set, of `effects`; of one that is not in the set by the middle of its variants.

        Without what the evidence was told `before`: nothing is told twice. What was `withdrawn` from the set, as no law bears it
        out, is these recordings' own affair. Parts of the set are taken to depart from their laws as real parts do, whether
        these data show it or not.
        """
        inside = {evidence.terms[number].key: number for number, _ in best.members}
        numbers = {
            key: inside.get(key, some[len(some) // 2])
            for key, some in evidence.of_key.items()
            if isinstance(key, EffectName) and key.effect in effects and key not in withdrawn
        }
        known = [(evidence.terms[k], evidence.places[k]) for k in numbers.values()]
        s = np.concatenate([np.zeros(0, np.intp), *(at[: term.laws] for term, at in known)])
        size = np.concatenate([np.zeros(0), *(np.full(term.laws, term.size) for term, _ in known)])
        p, sd = [np.zeros(0, np.intp)], [np.zeros(0)]
        for number, scale in best.members:
            term, own_sd = evidence.terms[number], evidence.scales[number][0][scale].copy()
            first = term.laws if term.key in numbers else 0
            if first:
                own_sd[first : first + term.departures] = ROUGH * own_sd[0]
            p.append(evidence.places[number][first:])
            sd.append(own_sd[first:])
        if before is not None:
            evidence = copy.copy(evidence)
            evidence.gram = before.beside(evidence.gram, evidence.terms, evidence.places, -1.0)
        factor = evidence.taken(np.concatenate(p), np.concatenate(sd), s, best.kappa)
        seen, pull = evidence.gram.among(s, s, best.kappa), evidence.gram.drawn(s, best.kappa)
        ends = itertools.accumulate((term.laws for term, _ in known), initial=0)
        places = {key: np.arange(*ab) for key, ab in zip(numbers, itertools.pairwise(ends), strict=True)}
        information = (seen - factor[:, :-1].T @ factor[:, :-1]) / np.outer(size, size)
        found = frozenset(key for key in numbers if key in inside)
        return cls(places, information, (pull - factor[:, :-1].T @ factor[:, -1]) / size, size, found)

    def widened(self, name: EffectName, covariance: Array) -> Told:
        """With a covariance (c, c) of one effect's unknowns that no Gram matrix has: (I^-1 + C)^-1, by Woodbury's identity."""
        across = self.information[:, self.places[name]]
        inner = np.eye(len(covariance)) + covariance @ across[self.places[name]]
        gain = across @ np.linalg.solve(inner, covariance)
        return dataclasses.replace(
            self, information=self.information - gain @ across.T, pull=self.pull - gain @ self.pull[self.places[name]]
        )

    def knows_better(self, name: EffectName, other: Told) -> bool:
        """Whether it determines an effect better than another does, beside all effects that either knows of."""
        return name in self.places and not self._variance(name) >= other._variance(name)

    def differs_from(self, other: Told, name: EffectName) -> bool:
        """Whether the two know an effect as two sizes, by what one unknown alone would at SURE_sd."""
        if name not in self.places or name not in other.places:
            return False
        (one, spread), (another, more) = self._estimate(name), other._estimate(name)
        apart = one - another
        return sureness(apart, spread + more, SURE_sd) > 1.0

    def words(self, name: EffectName) -> str:
        """An effect's parameters as they are known, in words."""
        made = parameters_of(name.effect)(*self._estimate(name))
        return ", ".join(f"{key} {value:.3g} +- {sd:.1g}" for key, (value, sd) in made.items())

    def _estimate(self, name: EffectName) -> tuple[Array, Array]:
        """Unknowns of an effect and their covariance, with a prior of usual sizes."""
        covariance = np.linalg.inv(self.information + np.diag(self.size**-2.0))
        at = self.places[name]
        return np.asarray((covariance @ self.pull)[at]), np.asarray(covariance[np.ix_(at, at)])

    def _variance(self, name: EffectName) -> float:
        """Of an effect's unknowns together; of one that it does not know, infinite."""
        if name not in self.places:
            return math.inf
        return float(np.trace(self._estimate(name)[1]))

    def beyond(self, arm: Arm, sign: float = 1.0) -> Told:
        """Of changes beside what the arm's file has, in place of totals; `sign` -1: the other way."""
        known = np.zeros(len(self.pull))
        for effect in arm.effects:
            if (places := self.places.get(EffectName(effect.effect, effect.joint))) is not None:
                known[places] = linear_values(effect.effect, effect.parameters)
        return dataclasses.replace(self, pull=self.pull - sign * self.information @ known)

    def beside(self, gram: Gram, terms: Sequence[Term], places: Sequence[Places], sign: float = 1.0) -> Gram:
        """A Gram matrix of terms, whose columns are at `places`, with what was told: no noise of its own inflates that. `sign`
        -1: without it.
        """
        if not self.places:
            return gram
        spread = np.zeros((len(gram.pull), len(self.pull)))
        for term, at in zip(terms, places, strict=True):
            for row, column in zip(at[: term.laws], self._of(term.key), strict=False):
                spread[row, column] = term.size
        added = sign * spread @ self.information @ spread.T
        return dataclasses.replace(
            gram,
            current=added if gram.current is None else gram.current + added,
            current_pull=gram.current_pull + sign * spread @ self.pull,
        )

    def _of(self, key: Key) -> Sequence[int]:
        return self.places[key].tolist() if isinstance(key, EffectName) and key in self.places else ()
