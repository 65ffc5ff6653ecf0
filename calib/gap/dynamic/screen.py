"""A first look at every candidate: how much of what is left it could take, to first order, and from where to start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import Array
from calib.gap.dynamic.catalogue import Candidate
from calib.gap.dynamic.fit import Fitted, Picked, columns
from calib.gap.dynamic.rows import Rows
from calib.gap.signals.terms import Term

FRICTION = {
    "coulomb_friction",
    "viscous_friction",
    "stribeck_friction",
    "stribeck exponential",
    "load_friction",
    "asymmetric_friction",
    "cogging",
    "drag",
    "cubic drag",
    "position friction",
    "position torque",
    "joint turn torque",
    "warming",
    "inertia",
}
NONNEGATIVE = {
    "stribeck_friction",
    "stribeck exponential",
    "load_friction",
    "supply_sag",
    "supply_sag by sum",
    "joint_compliance",
    "backlash",
    "link_flexure",
}
OTHER_FORM = 0.5  # of the best start's gain: another form of the same effect is then refined too
TRIED = 2.0  # a start whose first-order gain is 0 still gets this, so that it sorts behind all others


@dataclass(frozen=True, slots=True)
class Start:
    """A candidate's best start and the sum of squares that it would take off."""

    candidate: Candidate
    term: Term
    gain: float
    origin: Term  # the start in the catalogue, whose slopes say how the rows change
    change: tuple[float, ...]  # along those slopes
    others: tuple[Term, ...] = ()  # the best starts of the candidate's other forms


class Screen:
    """Slopes of all candidates' starts; those that do not depend on the model are computed once."""

    def __init__(self, rows: Rows, known: Sequence[Term], picked: Picked) -> None:
        self._rows, self._known, self._picked = rows, tuple(known), picked
        self._at_known = rows.residual(self._known)
        self._slopes: dict[Term, Array] = {}
        self._narrow: dict[Term, tuple[slice, Array]] = {}

    def best_start(self, candidate: Candidate, fitted: Fitted) -> Start:
        """The start that takes most off the fitted model's residual, the model's own values refitted beside it."""
        base = _orthogonal(fitted.slopes[self._picked])
        residual = fitted.residual[self._picked]
        starts = [self._start(candidate, term, fitted, base, residual) for term in self._of(candidate)]
        starts.sort(key=lambda start: -start.gain)
        best = starts[0]
        others: dict[str, Term] = {}
        for start in starts[1:]:
            if start.term.form != best.term.form and start.gain > OTHER_FORM * best.gain:
                others.setdefault(start.term.form, start.term)
        return replace(best, others=tuple(others.values()))

    def _of(self, candidate: Candidate) -> tuple[Term, ...]:
        first = candidate.starts[0]
        if self._rows.recording.has_tip and first.form in ("joint_compliance", "backlash"):
            return (first,)
        return candidate.starts

    def _start(self, candidate: Candidate, term: Term, fitted: Fitted, base: Array, residual: Array) -> Start:
        is_far = term.form in ("command_delay", "sampling time") or (
            term.form in ("joint_compliance", "backlash") and not self._rows.recording.has_tip
        )
        if is_far:
            ahead = self._rows.residual((*self._known, *fitted.terms, term))[self._picked]
            ahead = ahead - base @ (base.T @ ahead)
            return Start(candidate, term, float(residual @ residual - ahead @ ahead), term, ())
        where, slopes = self._picked_slopes(term)
        inside = base[where]
        seen = inside.T @ slopes
        values, gain = _solved(slopes.T @ slopes, seen, slopes.T @ residual[where])
        if term.form in NONNEGATIVE and values[0] < 0.0:
            return Start(candidate, term, -TRIED, term, ())
        full = list(term.values)
        for place, value in enumerate(values[: len(full)]):
            full[place] = float(value)
        return Start(candidate, term.at(tuple(full)), gain, term, tuple(values.tolist()))

    def pick(self, picked: Picked) -> None:
        """Look at these rows from now on."""
        self._picked = picked
        self._narrow.clear()

    def _picked_slopes(self, term: Term) -> tuple[slice, Array]:
        """Which of the picked rows a term changes, and its slopes there: a friction shows in one cell alone."""
        if term not in self._narrow:
            slopes = self.slopes(term)[self._picked]
            changed = np.flatnonzero(np.any(slopes != 0.0, axis=1))
            where = slice(int(changed[0]), int(changed[-1]) + 1) if len(changed) else slice(0, 0)
            self._narrow[term] = where, np.ascontiguousarray(slopes[where])
        return self._narrow[term]

    def slopes(self, term: Term) -> Array:
        """Slopes by those values that the rows are linear in, (rows, values)."""
        if term not in self._slopes:
            self._slopes[term] = self._computed(term)
        return self._slopes[term]

    def _computed(self, term: Term) -> Array:
        if term.form in ("joint_compliance", "backlash"):
            if not self._rows.recording.has_tip:
                ahead = self._rows.residual((*self._known, term))
                return np.asarray((ahead - self._at_known)[:, None] / term.values[0])
            return self._rows.at_rest_slope(term.form, term.index)[:, None]
        if term.form in FRICTION:
            counted = 1 if term.form.startswith("stribeck") else len(term.values)
            units = np.eye(len(term.values))[:counted]
            if term.form.startswith("stribeck"):
                units[0, 1] = term.values[1]
            parts = [self._rows.friction_slope(term.at(tuple(unit.tolist()))) for unit in units]
            return np.stack(parts, axis=1)
        slopes = columns(self._rows, (*self._known, term), len(self._known), self._at_known)
        return slopes[:, :1] if term.name.effect == "thermal_drift" else slopes


def _orthogonal(slopes: Array) -> Array:
    """An orthonormal basis of the columns."""
    if not slopes.shape[1]:
        return slopes
    size = np.linalg.norm(slopes, axis=0)
    u, s, _ = np.linalg.svd(slopes / np.where(size > 0, size, 1.0), full_matrices=False)
    return np.asarray(u[:, s > 1e-6 * s[0]])


def _solved(square: Array, seen: Array, pull: Array) -> tuple[Array, float]:
    """Values of least squares beside a base, and what they take off the sum of squares.

    `square`, `pull`: the slopes' products with themselves and the residual; `seen`: the base's with the slopes. The
    residual is orthogonal to the base already.
    """
    own = np.diag(square)
    free = square - seen.T @ seen
    is_free = np.diag(free) > 1e-9 * np.maximum(own, 1e-300)
    if not np.any(is_free):
        return np.zeros(len(own)), 0.0
    size = np.sqrt(np.where(is_free, np.diag(free), 1.0))
    scaled, pulled = free / np.outer(size, size), np.where(is_free, pull, 0.0) / size
    values, vectors = np.linalg.eigh(scaled)
    inverse = np.where(values > 1e-8 * values[-1], 1.0 / np.maximum(values, 1e-300), 0.0)
    solution = -(vectors * inverse) @ (vectors.T @ pulled)
    return np.asarray(solution / size), float(-solution @ pulled)
