"""The whole model as one linear problem: whitened residuals and columns of all terms, the geometry projected out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, Mask
from calib.gap.poses.currents import Currents
from calib.gap.posterior.evidence import Gram
from calib.gap.posterior.term import Term

FREE_PRECISION = 1e-6  # of an unknown without a bound, in its own scale


@dataclass(frozen=True, slots=True)
class Linear:
    """Around unknowns x: geometry `base` (3m, k), values `y` (3m,) and columns (3m, p) in metres, weights (m, 3, 3).

    y is the residual with all geometry deviations and terms at zero, so that priors around zero mean what they say.
    """

    base: Array
    precision: Array
    y: Array
    columns: Array
    weight: Array
    places: tuple[slice, ...]

    @classmethod
    def around(
        cls, problem: ArmProblem, x: Array, moved_m: Array, terms: Sequence[Term], weight: Array | None = None
    ) -> Linear:
        """`moved_m` (m, 3): what terms that the problem holds already do to the tip, to first order."""
        residual, jacobian = problem.residuals_and_jacobian(x)
        base = -jacobian.reshape(-1, len(x))
        by_joint = tip_by_joint(problem, x)
        columns = np.concatenate([moved_by(one, by_joint) for one in terms])
        ends = np.cumsum([one.count for one in terms])
        places = tuple(slice(int(end) - one.count, int(end)) for one, end in zip(terms, ends, strict=True))
        precision = np.array([1.0 if one.has_bound else FREE_PRECISION for one in problem.parameters])
        y = (residual + moved_m).ravel() + base @ x
        root = np.tile(np.eye(3), (len(residual), 1, 1)) if weight is None else weight
        return cls(base, precision, y, columns.reshape(len(columns), -1).T, root, places)

    def projected(self, rows: Mask, noise_m: float, more: tuple[Array, Array] | None = None) -> Gram:
        """What evidence needs, from the poses `rows` (m,); `more`: Gram and pull of the currents' channel."""
        root = self.weight[rows] / noise_m
        count = int(rows.sum())

        def white(values: Array) -> Array:
            own = values.reshape(len(rows), 3, -1)[rows]
            return np.asarray((root @ own).reshape(3 * count, -1))

        base, columns, y = white(self.base), white(self.columns), white(self.y)[:, 0]
        inner = np.linalg.cholesky(base.T @ base + np.diag(self.precision))
        taken = np.linalg.solve(inner, base.T @ columns)
        own = np.linalg.solve(inner, base.T @ y)
        # as residual plus prior's share, not as a difference of large numbers
        fit = np.linalg.solve(inner.T, np.column_stack((taken, own)))
        rest = np.column_stack((columns, y)) - base @ fit
        prior = np.sqrt(self.precision)[:, None] * fit
        seen = rest.T @ rest + prior.T @ prior
        used = float(np.sum(np.linalg.solve(inner, base.T) ** 2))
        zero = np.zeros((len(seen) - 1, len(seen) - 1)), np.zeros(len(seen) - 1)
        return Gram(seen[:-1, :-1], seen[:-1, -1], *(more or zero), float(seen[-1, -1]), 3 * count - used)

    def geometry(self, rows: Mask, noise_m: float, total: Array) -> tuple[Array, Array]:
        """Unknowns x (k,) of the geometry beside the terms' move `total` (3m,), and their covariance."""
        root = self.weight[rows] / noise_m
        base = (root @ self.base.reshape(len(rows), 3, -1)[rows]).reshape(-1, self.base.shape[1])
        left = (root @ (self.y - total).reshape(-1, 3, 1)[rows]).ravel()
        covariance = np.linalg.inv(base.T @ base + np.diag(self.precision))
        return np.asarray(covariance @ (base.T @ left)), np.asarray(covariance)


def tip_by_joint(problem: ArmProblem, x: Array) -> Array:
    """How the tip follows each joint, (m, 3, n)."""
    found = problem.solution(x)
    by_dh = problem.model.slopes(found.dh, problem.observed.q_rad, found.tool_m).by_dh
    return np.asarray(by_dh[:, :, list(problem.model.theta_places)])


def moved_by(one: Term, by_joint: Array) -> Array:
    """What a term's columns do to the tip, (c, m, 3)."""
    moved = np.zeros((one.count, len(by_joint), 3))
    if one.slope_rad is not None:
        for j in np.flatnonzero(one.slope_rad.any(axis=(0, 1))):
            moved += one.slope_rad[:, :, j, None] * by_joint[:, :, j]
    return moved if one.slope_m is None else moved + one.slope_m


def of_currents(currents: Currents | None, terms: Sequence[Term], rows: Mask) -> tuple[Array, Array] | None:
    """Gram and pull of the holding currents; friction, which shows in direction, is integrated out there."""
    if currents is None:
        return None
    shape = currents.torque_Nm.shape
    own = [k for k, one in enumerate(terms) if one.slope_Nm is not None]
    if not own:
        return None
    counts = np.array([one.count for one in terms])
    ends = np.cumsum(counts)
    which = np.concatenate([np.arange(ends[k] - counts[k], ends[k]) for k in own])
    columns = np.concatenate([terms[k].slope_Nm for k in own]).reshape(-1, *shape)
    gram, pull = np.zeros((ends[-1], ends[-1])), np.zeros(ends[-1])
    gram[np.ix_(which, which)], pull[which] = currents.seen(columns, rows)
    return gram, pull
