"""Which cause costs most: by how much the tip's error would fall if one were known exactly."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array
from calib.trust.discrepancy import Conditions, Discrepancy
from calib.trust.prediction import Predictor

_NUMBER = re.compile(r"\d+$")  # of the link, at the end of theta2


@dataclass(frozen=True, slots=True)
class Importance:
    """A cause, what is expected of it, and its part in what is not known; root mean squares over the poses [m].

    expected_m: displacement by its mean, which the arm's file does not correct. uncertain_m: by its own variance.
    without_m: what would be uncertain in all if this cause were known exactly.
    """

    name: str
    expected_m: float
    uncertain_m: float
    without_m: float


def importances(
    predictor: Predictor, problem: ArmProblem, discrepancy: Discrepancy, at: Conditions
) -> tuple[Importance, ...]:
    """Of every link's geometry, the tool, and every source, the costliest first."""
    columns = predictor.columns(at).reshape(-1, len(predictor.posterior.mean))
    gram = columns.T @ columns / len(at)
    groups = _groups([parameter.name for parameter in problem.parameters], discrepancy, predictor)
    found = [_importance(name, rows, predictor, gram) for name, rows in groups]
    return tuple(sorted(found, key=lambda one: -(one.expected_m**2 + one.uncertain_m**2)))


def _groups(
    names: Sequence[str], discrepancy: Discrepancy, predictor: Predictor
) -> list[tuple[str, list[int]]]:
    groups: dict[str, list[int]] = {}
    for k in predictor.own_places:
        name = names[k]
        kind = "the tool" if name.startswith("tool") else f"link {_link(name)}: geometry"
        groups.setdefault(kind, []).append(k)
    start = predictor.posterior.x_count
    for source, part in zip(discrepancy.sources, discrepancy.slices, strict=True):
        groups[source.name] = list(range(start + part.start, start + part.stop))
    return list(groups.items())


def _importance(name: str, rows: list[int], predictor: Predictor, gram: Array) -> Importance:
    mean, covariance = predictor.posterior.mean[rows], predictor.posterior.covariance
    own, mixed = covariance[np.ix_(rows, rows)], covariance[:, rows]
    here = gram[np.ix_(rows, rows)]
    left = covariance - mixed @ np.linalg.solve(own + 1e-15 * np.eye(len(rows)) * np.trace(own), mixed.T)
    return Importance(
        name,
        float(np.sqrt(max(0.0, float(mean @ here @ mean)))),
        float(np.sqrt(max(0.0, np.sum(here * own)))),
        float(np.sqrt(max(0.0, np.sum(gram * left)))),
    )


def _link(parameter: str) -> str:
    """The link's number in theta2."""
    found = _NUMBER.search(parameter)
    return found[0] if found else parameter
