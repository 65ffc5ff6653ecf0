"""What was measured of static poses, three values a row: the tips of all, then the orientations of those that have one.

An orientation is the rotation vector e of R_measured = exp([e]) R_modelled, times `lever_m` = noise of a tip / noise of an
orientation: all rows have the noise of a tip. How the measured target sits on the last link is an unknown of the geometry.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arm_problem.arm_model import FREE_sd, prior_sd
from calib.arm_problem.posed import PosedProblem
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, Mask, rms
from calib.gap.posterior.evidence import Gram
from calib.gap.posterior.term import Term
from calib.identify.objective import LeastSquares
from calib.identify.solver import minimise
from control.model.arm import Arm

SHORT = 0.2  # of the longest lever of all poses: the noise of a turn is five times as large there


@dataclass(frozen=True, slots=True)
class Residuals:
    """What a model leaves of the tips, (m, 3) [m], and of the orientations, (m, 3) [rad], NaN where there is none."""

    tip_m: Array
    turn_rad: Array

    def times(self, tip_m: float, turn_rad: float, rows: Mask) -> float:
        """Root mean square over the poses `rows`, in standard deviations of tip and orientation; NaN: of tips alone."""
        turned = self.turn_rad[rows] / turn_rad
        all_of_them = np.concatenate(((self.tip_m[rows] / tip_m).ravel(), turned[np.isfinite(turned)]))
        return rms(all_of_them)

    def sizes(self, rows: Mask) -> dict[str, float]:
        """Root mean squares of one axis by channel."""
        turned = self.turn_rad[rows]
        seen = turned[np.isfinite(turned)]
        return {"tip_m": rms(self.tip_m[rows])} | ({"turn_rad": rms(seen)} if len(seen) else {})


@dataclass(frozen=True, slots=True)
class Fit:
    """A fitted geometry: unknowns x (k,) of the problem, and how the measured target sits on the last link (3, 3) or None."""

    problem: ArmProblem
    x: Array
    target: Array | None

    @classmethod
    def to(cls, problem: ArmProblem, rows: Mask) -> Fit:
        """Fitted to the poses of a mask (m,); the geometry is near and interior, so that one search finds it."""
        subset = problem.of_rows(rows)
        if not len(subset.observed.turned_rows):
            return cls(problem, minimise(subset, LeastSquares(), 1).x, None)
        posed = PosedProblem(subset)
        x = minimise(posed, LeastSquares(), 1).x
        return cls(problem, x[: len(problem.parameters)], posed.target(x))

    @classmethod
    def nominal(cls, problem: ArmProblem, x: Array | None = None) -> Fit:
        """As the file has it, the target where the arm's orientations want it on average."""
        target = PosedProblem(problem).start if len(problem.observed.turned_rows) else None
        return cls(problem, np.zeros(len(problem.parameters)) if x is None else x, target)

    def shaped(self, arm: Arm) -> Arm:
        """An arm with this geometry and tool, on which the laws of effects act."""
        solution = self.problem.solution(self.x)
        x, y, z = solution.tool_m.tolist()
        return dataclasses.replace(arm.with_dh(solution.dh), tool=dataclasses.replace(arm.tool, position_m=(x, y, z)))

    def at(self, x: Array) -> Fit:
        """At unknowns (K,): those of this geometry, then a turn of the target from where it is."""
        posed = self.posed()
        target = None if posed is None else posed.target(x)
        return dataclasses.replace(self, x=x[: len(self.x)], target=target)

    def residuals(self) -> Residuals:
        """The residuals."""
        turned = np.full((len(self.problem), 3), np.nan)
        if (posed := self.posed()) is not None:
            turned[posed.rows] = posed.angles_rad(self._whole(posed))
        return Residuals(self.problem.residuals(self.x), turned)

    def posed(self) -> PosedProblem | None:
        """The problem with its orientations, where there are any."""
        if self.target is None:
            return None
        posed = PosedProblem(self.problem)
        posed.start = self.target
        return posed

    def _whole(self, posed: PosedProblem) -> Array:
        return np.concatenate((self.x, np.zeros(len(posed.parameters) - len(self.x))))

    def measured(self, lever_m: float) -> Measured:
        """All rows around the fit; without orientations where nothing tells their noise (`lever_m` 0)."""
        count, posed = len(self.problem), self.posed() if lever_m > 0.0 else None
        tips = np.arange(count)
        by_joint, turned_by_joint = by_joints(self)
        if posed is None:
            return Measured(*self.problem.residuals_and_jacobian(self.x), tips, 0.0, by_joint)
        residual, jacobian = posed.residuals_and_jacobian(self._whole(posed))
        scale = np.ones((len(residual), 1))
        scale[count:] = lever_m / posed.lever_m
        return Measured(
            residual * scale,
            jacobian * scale[:, :, None],
            np.concatenate((tips, posed.rows)),
            lever_m,
            np.concatenate((by_joint, lever_m * turned_by_joint[posed.rows])),
        )


@dataclass(frozen=True, slots=True)
class Measured:
    """R rows around a fit: residual (R, 3) and jacobian (R, 3, K) [m], the pose of each (R,), `by_joint` (R, 3, n) [m/rad]."""

    residual: Array
    jacobian: Array
    pose: npt.NDArray[np.intp]
    lever_m: float
    by_joint: Array

    def of(self, poses: Mask) -> Mask:
        """The rows (R,) of some poses (m,)."""
        return poses[self.pose]

    def rows_of(self, moved: Array) -> Array:
        """Moves of every pose as tip and turn, (..., m, 6), as rows (..., R, 3)."""
        tips, turned = moved[..., :3], self.lever_m * moved[..., self._turned, 3:]
        return np.concatenate((tips, turned), axis=-2)

    def moved_by(self, term: Term) -> Array:
        """What a term's columns do, (c, R, 3)."""
        moved = np.zeros((term.count, len(self.pose), 3))
        if term.slope_rad is not None:
            for j in np.flatnonzero(term.slope_rad.any(axis=(0, 1))):
                moved += term.slope_rad[:, self.pose, j, None] * self.by_joint[:, :, j]
        tips = len(self.pose) - len(self._turned)
        if term.slope_m is not None:
            moved[:, :tips] += term.slope_m
        if term.turn_rad is not None:
            moved[:, tips:] += self.lever_m * term.turn_rad[:, self._turned]
        return moved

    def as_residuals(self, residual: Array) -> Residuals:
        """Residuals (R, 3) or (3R,) [m] as what they are of."""
        rows = residual.reshape(-1, 3)
        tips = len(rows) - len(self._turned)
        turned = np.full((tips, 3), np.nan)
        if self.lever_m > 0.0:
            turned[self._turned] = rows[tips:] / self.lever_m
        return Residuals(rows[:tips], turned)

    @property
    def _turned(self) -> npt.NDArray[np.intp]:
        """Poses of the rows of orientation: those behind the last pose's tip."""
        return self.pose[int(self.pose.max(initial=-1)) + 1 :]


def by_joints(fit: Fit) -> tuple[Array, Array]:
    """How tip and last link follow each joint, (m, 3, n) each. A turn's axis is how the tip follows a move along it."""
    problem, solution = fit.problem, fit.problem.solution(fit.x)
    by_dh = problem.model.slopes(solution.dh, problem.observed.q_rad, solution.tool_m).by_dh
    theta = np.array(problem.model.theta_places)
    return np.asarray(by_dh[:, :, theta]), np.asarray(by_dh[:, :, theta - 1])


@dataclass(frozen=True, slots=True)
class Linear:
    """Around a fit, of its R rows: geometry `base` (3R, K), values `y` (3R,) and columns (3R, p) in metres, weights (R, 3, 3).

    y is the residual with all geometry deviations and terms at zero, so that priors around zero mean what they say. The last
    unknowns of the geometry are the turn of the measured target, if there is one.
    """

    base: Array
    precision: Array
    y: Array
    columns: Array
    weight: Array
    places: tuple[slice, ...]
    measured: Measured

    @classmethod
    def around(
        cls,
        fit: Fit,
        lever_m: float,
        terms: Sequence[Term],
        moved: Array | None = None,
        weight: Array | None = None,
        follows: Array | None = None,
    ) -> Linear:
        """`moved` (m, 6): what terms that the fit's problem holds already do to tip and last link, to first order; `follows`
        (m, 6, k): how that follows the geometry.
        """
        measured = fit.measured(lever_m)
        count = measured.jacobian.shape[2]
        base = -measured.jacobian.reshape(-1, count)
        if follows is not None:
            rows = measured.rows_of(np.moveaxis(follows, 2, 0))
            base[:, : len(fit.x)] += rows.reshape(len(rows), -1).T
        columns = np.concatenate([measured.moved_by(term) for term in terms])
        ends = np.cumsum([term.count for term in terms])
        places = tuple(slice(int(end) - term.count, int(end)) for term, end in zip(terms, ends, strict=True))
        precision = np.full(count, FREE_sd**-2.0)
        precision[: len(fit.x)] = prior_sd(fit.problem.parameters, 1.0) ** -2.0
        known = measured.residual if moved is None else measured.residual + measured.rows_of(moved)
        y = known.ravel() + base[:, : len(fit.x)] @ fit.x
        root = np.tile(np.eye(3), (len(measured.pose), 1, 1)) if weight is None else weight
        return cls(base, precision, y, columns.reshape(len(columns), -1).T, root, places, measured)

    @property
    def columns_of_terms(self) -> list[npt.NDArray[np.intp]]:
        """The places of each term's columns."""
        return [np.arange(place.start, place.stop) for place in self.places]

    def projected(self, poses: Mask, noise_m: float, held: Array | None = None, beside: Term | None = None) -> Gram:
        """What evidence needs, from some poses (m,). `beside`: what else is integrated out, of prior standard deviation one.

        `held` (r, K + p + 1): the holding currents' channel, geometry, columns and values in standard deviations. Both channels
        see one geometry: what the tips leave open of it is integrated out of the currents.
        """
        base, precision, count = self.base, self.precision, self.base.shape[1]
        if beside is not None:
            base = np.column_stack((base, self.measured.moved_by(beside).reshape(beside.count, -1).T))
            precision = np.concatenate((precision, np.ones(beside.count)))
            held = None if held is None else np.insert(held, [count] * beside.count, 0.0, axis=1)
        base, columns, y = (self.whitened(values, poses, noise_m) for values in (base, self.columns, self.y[:, None]))
        values = np.column_stack((columns, y))
        # the prior as rows of its own: what tips leave open, a factor 1e8 in size, is lost in normal equations
        q, r = np.linalg.qr(np.vstack((base, np.diag(np.sqrt(precision)))))
        fit = np.linalg.solve(r, q[: len(base)].T @ values)
        rest = np.vstack((values, np.zeros_like(fit))) - q @ (q[: len(base)].T @ values)
        seen = rest.T @ rest
        used = float(np.sum(q[: len(base)] ** 2))
        gram = Gram(seen[:-1, :-1], seen[:-1, -1], None, np.zeros(len(seen) - 1), float(seen[-1, -1]), len(base) - used)
        if held is None:
            return gram
        more = _beside(r.T @ r, fit, held)
        return dataclasses.replace(gram, current=more[:-1, :-1], current_pull=more[:-1, -1])

    def geometry(self, poses: Mask, noise_m: float, total: Array) -> Array:
        """Unknowns (K,) of the geometry beside the terms' move `total` (3R,)."""
        base = self.whitened(self.base, poses, noise_m)
        residual = self.whitened((self.y - total)[:, None], poses, noise_m)[:, 0]
        rows = np.vstack((base, np.diag(np.sqrt(self.precision))))
        return np.asarray(np.linalg.lstsq(rows, np.concatenate((residual, np.zeros(len(self.precision)))))[0])

    def whitened(self, values: Array, poses: Mask, noise_m: float) -> Array:
        """Values (3R, c) at some poses (m,), in standard deviations of the noise."""
        rows = self.measured.of(poses)
        selected = values.reshape(len(rows), 3, -1)[rows]
        return np.asarray((self.weight[rows] / noise_m @ selected).reshape(3 * int(rows.sum()), -1))


def _beside(known: Array, fit: Array, held: Array) -> Array:
    """Sums of squares of a second channel, whose values have their base where a first one fits it: `fit` (K, v) with the inverse
    covariance `known` (K, K). `held` (r, K + v): base and values.

    E' (I + B known^-1 B')^-1 E with E = values - B fit, by Woodbury's identity.
    """
    base = held[:, : len(known)]
    residual = held[:, len(known) :] - base @ fit
    explained = np.linalg.solve(np.linalg.cholesky(known + base.T @ base), base.T @ residual)
    return np.asarray(residual.T @ residual - explained.T @ explained)


def along_joint(lever_m: Array, residual_m: Array) -> Array:
    """The turn of a joint that would explain most of each residual (m, 3); lever_m (m, 3): how tips follow the joint; (m,).

    NaN where the tip is near the joint's axis: its noise there is many times that of the other turns.
    """
    square = np.einsum("mi,mi->m", lever_m, lever_m)
    far = square > np.square(SHORT) * square.max()
    along = np.einsum("mi,mi->m", lever_m, residual_m)
    return np.asarray(along / np.where(far, square, np.nan))
