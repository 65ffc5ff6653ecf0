"""Least squares over a model's terms, and what the fit would have said of each run had it not seen it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arrays import Array
from calib.gap.dynamic.rows import Rows
from calib.gap.signals.terms import STEP, Term

Picked = npt.NDArray[np.bool_]
ITERATIONS = 8
FASTEST_STRIBECK_rad_s = 0.35  # a fall over all speeds of an arm is Coulomb friction with something else
QUICKEST_WARMING_s = 0.6  # quicker, a drift has gone by before a run counts, and is a zero
LATEST_s = 0.02  # of a sample after the voltage that it follows
PROMISED = 1e-4  # of the sum of squares: a step that promises less is not tried
ENOUGH = 1e-3  # of the sum of squares: a step that gains less is the last


@dataclass(frozen=True, slots=True)
class Fitted:
    """Terms at their optimum on the picked rows; residual over all rows; covariance of all values together.

    `held_out` is the sum of squares over the picked rows, each group predicted without itself.
    """

    terms: tuple[Term, ...]
    residual: Array
    slopes: Array
    covariance: Array
    picked: float
    held_out: float


def columns(rows: Rows, model: Sequence[Term], k: int, at: Array) -> Array:
    """Slopes of the rows by the values of model[k], (rows, values); `at`: the rows of the model."""
    result = []
    for neighbour, step in model[k].neighbours():
        ahead = rows.residual((*model[:k], neighbour, *model[k + 1 :]))
        result.append((ahead - at) / step)
    return np.stack(result, axis=1)


def refine(
    rows: Rows, known: Sequence[Term], terms: Sequence[Term], picked: Picked, groups: Sequence[Picked]
) -> Fitted:
    """Levenberg-Marquardt from the terms' values; `groups` are the row sets that are held out in turn."""
    values = [np.array(term.values) for term in terms]
    damping = 1e-6
    model = _model(known, terms, values)
    residual = rows.residual(model)
    best = float(residual[picked] @ residual[picked])
    slopes = _all_slopes(rows, known, terms, values, residual)
    for _ in range(ITERATIONS if terms else 0):
        step = _step(slopes[picked], residual[picked], damping)
        foreseen = residual[picked] + slopes[picked] @ step
        if best - float(foreseen @ foreseen) < PROMISED * best:
            break
        moved = _moved(terms, values, step)
        trial = rows.residual(_model(known, terms, moved))
        total = float(trial[picked] @ trial[picked])
        if total < best:
            gained, best = best - total, total
            values, residual, damping = moved, trial, max(damping * 0.1, 1e-9)
            linear = all(term.form not in STEP for term in terms)
            if gained < ENOUGH * best or (linear and gained < 1e-2 * best):
                break
            slopes = _all_slopes(rows, known, terms, values, residual)
        else:
            damping = max(damping * 30.0, 1e-3)
            if damping > 1e4:
                break
    done = tuple(term.at(tuple(v.tolist())) for term, v in zip(terms, values, strict=True))
    inner = slopes[picked]
    covariance = _inverse(inner.T @ inner)
    spread = max(1.0, best / max(int(picked.sum()), 1))
    held_out = _held_out(slopes, residual, groups)
    return Fitted(done, residual, slopes, covariance * spread, best, held_out)


def _model(known: Sequence[Term], terms: Sequence[Term], values: Sequence[Array]) -> tuple[Term, ...]:
    return (*known, *(term.at(tuple(v.tolist())) for term, v in zip(terms, values, strict=True)))


def _all_slopes(
    rows: Rows, known: Sequence[Term], terms: Sequence[Term], values: Sequence[Array], residual: Array
) -> Array:
    if not terms:
        return np.zeros((len(residual), 0))
    model = _model(known, terms, values)
    return np.hstack([columns(rows, model, len(known) + k, residual) for k in range(len(terms))])


def _step(slopes: Array, residual: Array, damping: float) -> Array:
    size = np.linalg.norm(slopes, axis=0)
    size[size == 0.0] = 1.0
    scaled = slopes / size
    square = scaled.T @ scaled
    # Directions that these rows hardly determine (DH rows that move nothing) are left where they are.
    values, vectors = np.linalg.eigh(square)
    inverse = np.where(values > 1e-9 * values[-1], 1.0 / (values + damping), 0.0)
    return np.asarray(-(vectors * inverse) @ (vectors.T @ (scaled.T @ residual)) / size)


def _inverse(square: Array) -> Array:
    if not len(square):
        return square
    size = np.sqrt(np.maximum(np.diag(square), 1e-300))
    values, vectors = np.linalg.eigh(square / np.outer(size, size))
    inverse = np.where(values > 1e-9 * values[-1], 1.0 / np.maximum(values, 1e-300), 0.0)
    return np.asarray((vectors * inverse) @ vectors.T / np.outer(size, size))


def _moved(terms: Sequence[Term], values: Sequence[Array], step: Array) -> list[Array]:
    result, start = [], 0
    for term, value in zip(terms, values, strict=True):
        moved = value + step[start : start + len(value)]
        start += len(value)
        result.append(np.array(bounded(term, moved)))
    return result


def bounded(term: Term, values: Array) -> Array:
    """Values kept where the effect means something."""
    result = np.array(values)
    match term.form:
        case "stribeck_friction" | "stribeck exponential":
            result[0], result[1] = max(result[0], 0.0), min(max(result[1], 0.004), FASTEST_STRIBECK_rad_s)
        case "load_friction" | "supply_sag" | "supply_sag by sum" | "command_delay":
            result[0] = max(result[0], 0.0)
        case "sampling time":
            result[0] = min(max(result[0], 0.0), LATEST_s)
        case "joint_compliance":
            result[0] = min(max(result[0], 1e-6), 0.05)
            result[1] = min(max(result[1], 0.0), 20.0)
            result[2:] = np.clip(result[2:], 0.0, 1.0)
        case "backlash":
            result[0] = min(max(result[0], 0.0), 0.2)
            result[1:] = np.clip(result[1:], 0.0, 1.0)
        case "link_flexure":
            result[0] = min(max(result[0], 1e-6), 1.0)
        case "thermal_drift" | "thermal_drift seen":
            result[1] = min(max(result[1], QUICKEST_WARMING_s), 1e5)
        case "torque_constant":
            result[0] = min(max(result[0], -0.8), 4.0)
        case _:
            pass
    return result


def _held_out(slopes: Array, residual: Array, groups: Sequence[Picked]) -> float:
    """Each group's sum of squares with the values that the other groups give, to first order."""
    squares = [slopes[g].T @ slopes[g] for g in groups]
    pulls = [slopes[g].T @ residual[g] for g in groups]
    if len(groups) < 2:
        return float(sum(np.sum(residual[g] ** 2) for g in groups))
    square, pull = np.sum(squares, axis=0), np.sum(pulls, axis=0)
    total = 0.0
    for g, own_square, own_pull in zip(groups, squares, pulls, strict=True):
        change = -_inverse(square - own_square) @ (pull - own_pull)
        rest = residual[g] + slopes[g] @ change
        total += float(rest @ rest)
    return total
