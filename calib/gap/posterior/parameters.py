"""Parameters of what is named, as totals, with standard deviations that count departures, variants and the geometry in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, ndtr

from calib.arrays import Array
from calib.gap.finding import Parameters
from calib.gap.posterior.constants import NEGLIGIBLE, CHANGED_sd
from calib.gap.posterior.evidence import Evidence
from calib.gap.posterior.search import Weighed
from calib.gap.posterior.term import Key, Term


@dataclass(frozen=True, slots=True)
class Estimated:
    """An effect of the set: parameters with sd, and how far it departs from its law, as a share, in which variable.

    `variants`: numbers of the terms that may be it, and their posterior weights.
    """

    parameters: Parameters
    departure: float
    variable: str
    value: Array
    covariance: Array
    variants: tuple[tuple[int, float], ...]

    @property
    def sd(self) -> Array:
        """Standard deviations of `value`, (c,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def differs_from(self, other: Array) -> bool:
        """Whether the coefficients differ from others (c,) by what one of them alone would at CHANGED_sd."""
        apart = self.value - other
        least = chdtri(len(apart), 2.0 * ndtr(-CHANGED_sd))  # of chi-square
        return bool(apart @ np.linalg.solve(self.covariance, apart) > least)


def estimated(evidence: Evidence, found: Weighed, key: Key) -> Estimated:
    """Averaged over the variants and sizes of the effect, all others at their best."""
    rest = [one for one in found.members if evidence.terms[one[0]].key != key]
    means, covariances, weights, departs, terms, numbers = [], [], [], [], [], []
    for number, scale, log in _ways(evidence, found, rest, key):
        term = evidence.terms[number]
        size, covariance = evidence.estimate([*rest, (number, scale)], found.kappa)
        own = slice(len(size) - term.count, len(size) - term.count + term.laws)
        means.append(size[own] * term.size)
        covariances.append(covariance[own, own] * term.size**2)
        departs.append(_departure(term, size[len(size) - term.count :]))
        weights.append(np.exp(log))
        terms.append(term)
        numbers.append(number)
    share = np.array(weights) / np.sum(weights)
    mean = np.einsum("v,vc->c", share, np.array(means))
    apart = np.array(means) - mean
    covariance = np.einsum("v,vcd->cd", share, np.array(covariances)) + np.einsum(
        "v,vc,vd->cd", share, apart, apart
    )
    best = terms[int(np.argmax(share))]
    named = best.parameters(mean, covariance) if best.parameters is not None else {}
    summed = dict.fromkeys(numbers, 0.0)
    for number, weight in zip(numbers, share.tolist(), strict=True):
        summed[number] += weight
    departs_by = float(share @ np.array(departs))
    return Estimated(named, departs_by, best.variable, mean, covariance, tuple(summed.items()))


def _ways(
    evidence: Evidence, found: Weighed, rest: list[tuple[int, int]], key: Key
) -> list[tuple[int, int, float]]:
    """Variants and sizes that count, with their log evidence; those of exact laws left out, where a law may depart.

    No real part keeps its law: an interval holds only if it counts the departures that the data do not show.
    """
    ways = [
        (number, scale, evidence.value([*rest, (number, scale)], found.kappa))
        for number in evidence.of_key[key]
        for scale in range(len(evidence.weights[number]))
        if not is_exact(evidence, number, scale)
    ]
    top = max(log for _, _, log in ways)
    return [(number, scale, log - top) for number, scale, log in ways if log > top - NEGLIGIBLE]


def is_exact(evidence: Evidence, number: int, scale: int) -> bool:
    """Whether a size leaves a law that may depart as the textbook has it."""
    term = evidence.terms[number]
    departs = evidence.scales[number][0][scale][term.laws : term.laws + term.departures]
    return term.departures > 0 and not departs.any()


def _departure(term: Term, size: Array) -> float:
    """How far what an effect does is from every multiple of its law, over what it does; root mean squares.

    What a departure has of the law makes the effect another size, and its mean is another zero of the joint.
    """
    slope = next((one for one in (term.slope_rad, term.slope_m, term.slope_Nm) if one is not None), None)
    if slope is None or not term.departures:
        return 0.0
    own = slope[: term.laws + term.departures]
    about = own - own.mean(axis=1, keepdims=True) if slope is term.slope_rad else own
    flat = about.reshape(len(own), -1).T
    law, whole = flat[:, : term.laws], flat @ size[: len(own)]
    rest = whole - law @ np.linalg.lstsq(law, whole, rcond=None)[0]
    done = float(np.linalg.norm(np.tensordot(size[: len(own)], own, 1)))
    return float(np.linalg.norm(rest)) / done if done > 0.0 else 0.0
