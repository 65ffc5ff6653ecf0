"""Parameters of what is named, as totals, with standard deviations that count departures, variants and the geometry in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.poses.candidate import Parameters
from calib.gap.posterior.evidence import Evidence
from calib.gap.posterior.search import Weighed
from calib.gap.posterior.term import Key, Term

NEGLIGIBLE = 5.0  # log evidence below the best at which a variant or a size does not count


@dataclass(frozen=True, slots=True)
class Estimated:
    """An effect of the set: parameters with sd, and how far it departs from its law, as a share, in which variable."""

    parameters: Parameters
    departure: float
    variable: str
    value: Array
    sd: Array


def estimated(evidence: Evidence, found: Weighed, key: Key) -> Estimated:
    """Averaged over the variants and sizes of the effect, all others at their best."""
    rest = [one for one in found.members if evidence.terms[one[0]].key != key]
    means, covariances, weights, departs, terms = [], [], [], [], []
    for number, scale, log in _ways(evidence, found, rest, key):
        term = evidence.terms[number]
        size, covariance = evidence.estimate([*rest, (number, scale)], found.kappa)
        own = slice(len(size) - term.count, len(size) - term.count + term.laws)
        means.append(size[own] * term.size)
        covariances.append(covariance[own, own] * term.size**2)
        departs.append(_departure(term, size[len(size) - term.count :]))
        weights.append(np.exp(log))
        terms.append(term)
    share = np.array(weights) / np.sum(weights)
    mean = np.einsum("v,vc->c", share, np.array(means))
    apart = np.array(means) - mean
    covariance = np.einsum("v,vcd->cd", share, np.array(covariances)) + np.einsum(
        "v,vc,vd->cd", share, apart, apart
    )
    best = terms[int(np.argmax(share))]
    named = best.parameters(mean, covariance) if best.parameters is not None else {}
    return Estimated(
        named, float(share @ np.array(departs)), best.variable, mean, np.sqrt(np.diag(covariance))
    )


def _ways(
    evidence: Evidence, found: Weighed, rest: list[tuple[int, int]], key: Key
) -> list[tuple[int, int, float]]:
    """Variants and sizes that count, with their log evidence."""
    ways = [
        (number, scale, evidence.value([*rest, (number, scale)], found.kappa))
        for number in evidence.of_key[key]
        for scale in range(len(evidence.weights[number]))
    ]
    top = max(log for _, _, log in ways)
    return [(number, scale, log - top) for number, scale, log in ways if log > top - NEGLIGIBLE]


def _departure(term: Term, size: Array) -> float:
    """Root mean square of the departure columns over that of the law's."""
    slope = (
        term.slope_rad
        if term.slope_rad is not None
        else term.slope_m
        if term.slope_m is not None
        else term.slope_Nm
    )
    if slope is None or not term.departures:
        return 0.0
    law = np.tensordot(size[: term.laws], slope[: term.laws], 1)
    more = slice(term.laws, term.laws + term.departures)
    rest = np.tensordot(size[more], slope[more], 1)
    whole = float(np.sqrt(np.mean(law**2)))
    return float(np.sqrt(np.mean(rest**2))) / whole if whole > 0.0 else 0.0
