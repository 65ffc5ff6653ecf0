"""Geometry, discrepancy and noise together: their most probable sizes, and the distribution of everything given the poses.

Residuals of m poses are r(x) = F f + noise: x are the identification's unknowns, f the weights of the discrepancy's columns F.
Priors: a bounded deviation is anywhere within its bound (variance of the uniform distribution), a frame anywhere, a weight
normal with its source's size. Sizes and noise are those of the largest evidence (MacKay, Bayesian interpolation, Neural
Computation 4, 1992), with a broad prior about the usual sizes: what no pose tests keeps the usual size and does not vanish.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from calib.arm_problem.problem import ArmProblem, ModelValues
from calib.arrays import Array
from calib.trust.discrepancy import Conditions, Discrepancy

UNIFORM: Final = 1.0 / 3.0  # variance of a deviation that is anywhere within -1 .. 1
SIZE_SPREAD: Final = 2.0  # standard deviation of a size's logarithm about the usual one
NOISE_m: Final = 1e-4  # usual noise of one axis; its logarithm is as good as free
NOISE_SPREAD: Final = 3.0
SIZE_LIMIT: Final = 7.0  # of a logarithm about the usual one: a thousandth to a thousand times
SIZES: Final = np.linspace(-3.0, 3.0, 13)  # of logarithms about the most probable one: to twenty times it
ROUNDS: Final = 4  # linearisations
STEPS_MOST: Final = 200
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Posterior:
    """Normal distribution of the unknowns z = (x, f): mean (k,), covariance (k, k); x are the first `x_count`.

    noise_m: standard deviation of one axis that nothing explains; sizes: of each source, in its unit. `odds`: of friction's
    shares, for `Discrepancy.knowing`.
    """

    mean: Array
    covariance: Array
    x_count: int
    noise_m: float
    sizes: Array
    odds: Array

    @property
    def x(self) -> Array:
        """The identification's unknowns."""
        return self.mean[: self.x_count]

    def draws(self, count: int, seed: int) -> Array:
        """Unknowns (count, k) from the distribution."""
        values, vectors = np.linalg.eigh(self.covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        normal = np.random.default_rng(seed).standard_normal((count, len(self.mean)))
        return np.asarray(self.mean + normal @ root.T)


def posterior_of(
    problem: ArmProblem, at: Conditions, discrepancy: Discrepancy, used: Mask | None = None
) -> Posterior:
    """The posterior of the poses `at` that `problem` holds; of the rows `used` (m,) alone, if given."""
    rows = np.ones(len(problem), dtype=bool) if used is None else used
    x = np.zeros(len(problem.parameters))
    variance = np.array([UNIFORM if one.has_bound else 1.0 for one in problem.parameters])
    logs: Array | None = None
    loose_m2 = np.zeros((len(problem), 3, 3))
    for _ in range(ROUNDS):
        design, wanted = linearised(problem, at, discrepancy, x)
        if logs is not None:
            design, wanted = _weighted(design, wanted, np.exp(-2.0 * logs[0]) * loose_m2)
        evidence = SizeEvidence(design[rows], wanted[rows], variance, discrepancy)
        logs = evidence.best(logs)
        found = evidence.posterior(logs)
        x = np.clip(found.x, -1.0 * _limits(problem), _limits(problem))
        odds, flank = _weighed(problem, at, discrepancy, found, rows)
        discrepancy, at = discrepancy.knowing(odds), replace(at, flank=flank)
        loose_m2 = loose_play_m2(discrepancy, at, problem.solution(x), found)
    return evidence.over_sizes(found)


def _weighed(
    problem: ArmProblem, at: Conditions, discrepancy: Discrepancy, found: Posterior, rows: Mask
) -> tuple[Array, Array | None]:
    """What the rows say about the shares of friction, and about their own flanks, given the play that the posterior expects."""
    design, wanted = linearised(problem, at, discrepancy, found.x)
    solved = problem.solution(found.x)
    plays = discrepancy.plays_rad(at, found.mean[found.x_count :])
    moves_m = discrepancy.by_play(at, solved.dh, solved.tool_m) * plays[:, None, :]
    left_m = design @ found.mean - wanted
    return discrepancy.weighed(at, left_m * rows[:, None], moves_m * rows[:, None, None], found.noise_m)


def linearised(
    problem: ArmProblem, at: Conditions, discrepancy: Discrepancy, x: Array
) -> tuple[Array, Array]:
    """Rows A (m, 3, k) and right-hand sides (m, 3) with A z = rhs + noise, around unknowns x."""
    residuals, jacobian = problem.residuals_and_jacobian(x)
    solved = problem.solution(x)
    columns = discrepancy.columns(at, solved.dh, solved.tool_m)
    return np.concatenate((jacobian, -columns), axis=2), np.asarray(jacobian @ x - residuals)


def loose_play_m2(discrepancy: Discrepancy, at: Conditions, solved: ModelValues, found: Posterior) -> Array:
    """Covariance of the tip (m, 3, 3) by gears that lie anywhere in their play."""
    plays = discrepancy.plays_rad(at, found.mean[found.x_count :])
    moves = discrepancy.unclear(at, solved.dh, solved.tool_m) * plays[:, None, :]
    return np.asarray(np.einsum("mij,mkj->mik", moves, moves))


def _weighted(design: Array, wanted: Array, excess: Array) -> tuple[Array, Array]:
    """Rows of unit noise, from rows whose noise has the covariance 1 + excess (m, 3, 3)."""
    root = np.linalg.inv(np.linalg.cholesky(np.eye(3) + excess))
    return root @ design, np.einsum("mij,mj->mi", root, wanted)


def _limits(problem: ArmProblem) -> Array:
    return np.array([one.limit for one in problem.parameters])


class SizeEvidence:
    """The evidence of sizes and noise for one linearisation."""

    def __init__(self, design: Array, wanted: Array, x_variance: Array, discrepancy: Discrepancy) -> None:
        flat, y = design.reshape(-1, design.shape[2]), wanted.ravel()
        self._gram, self._moment, self._power, self._count = flat.T @ flat, flat.T @ y, float(y @ y), len(y)
        self._x_precision = 1.0 / x_variance
        self._slices, self._odds = discrepancy.slices, discrepancy.odds
        self._widths = np.array([source.count for source in discrepancy.sources])
        usual = np.array([NOISE_m, *(source.usual for source in discrepancy.sources)])
        self._usual = np.log(usual)
        self._spread = np.array([NOISE_SPREAD, *np.full(len(usual) - 1, SIZE_SPREAD)])

    def best(self, start: Array | None) -> Array:
        """The most probable logarithms of noise and sizes, (1 + sources,)."""
        from scipy.optimize import fmin_l_bfgs_b

        begin = self._usual if start is None else start
        box = [(one - SIZE_LIMIT, one + SIZE_LIMIT) for one in self._usual]
        return np.asarray(fmin_l_bfgs_b(self.minus_log, begin, bounds=box, maxiter=STEPS_MOST)[0])

    def posterior(self, logs: Array) -> Posterior:
        """The unknowns' distribution, given noise and sizes."""
        mean, covariance, _ = self._solved(logs)
        sizes = np.exp(logs)
        return Posterior(mean, covariance, len(self._x_precision), float(sizes[0]), sizes[1:], self._odds)

    def over_sizes(self, found: Posterior) -> Posterior:
        """The same, averaged over what the poses leave open of each source's size, the others at their most probable ones.

        The most probable size of a source that the poses hardly show is far below what it may be, which matters where they did
        not go. Another size changes the precision of the source's weights f alone, by d: the covariance C becomes
        C - C_f M C_f', the mean m - C_f M m_f, with M = (1 + d C_ff)^-1 d, and twice the logarithm of the evidence falls by
        log det(1 + d C_ff) + n log(size^2 ratio) + m_f' M m_f. The mean of these normal distributions over a grid of sizes is
        matched by its first two moments; no covariance becomes smaller by it.
        """
        mean, covariance = found.mean.copy(), found.covariance.copy()
        logs = np.log(np.concatenate(([found.noise_m], found.sizes)))
        for k, part in enumerate(self._slices, start=1):
            rows = slice(part.start + found.x_count, part.stop + found.x_count)
            here, weights = found.covariance[rows, rows], found.mean[rows]
            grid = np.clip(SIZES + logs[k], self._usual[k] - SIZE_LIMIT, self._usual[k] + SIZE_LIMIT)
            steps, odds = [], []
            for size in grid:
                change = math.exp(-2.0 * size) - math.exp(-2.0 * logs[k])
                inner = np.eye(len(weights)) + change * here
                step = change * np.linalg.inv(inner)
                steps.append(step)
                cost = np.linalg.slogdet(inner)[1] + 2.0 * len(weights) * (size - logs[k])
                prior = ((size - self._usual[k]) / SIZE_SPREAD) ** 2
                odds.append(-0.5 * (cost + float(weights @ step @ weights) + prior))
            share = np.exp(np.array(odds) - max(odds))
            share /= share.sum()
            usual = np.einsum("g,gij->ij", share, np.array(steps))
            off = np.array([(step - usual) @ weights for step in steps])
            more = np.einsum("g,gi,gj->ij", share, off, off) - usual
            values, vectors = np.linalg.eigh(0.5 * (more + more.T))
            wider = found.covariance[:, rows] @ (vectors * np.sqrt(np.maximum(values, 0.0)))
            covariance += wider @ wider.T
            mean -= found.covariance[:, rows] @ usual @ weights
        return replace(found, mean=mean, covariance=covariance)

    def _solved(self, logs: Array) -> tuple[Array, Array, float]:
        """Mean, covariance, log determinant of the precision."""
        precision = np.exp(-2.0 * logs[0]) * self._gram
        priors = np.concatenate((self._x_precision, np.repeat(np.exp(-2.0 * logs[1:]), self._widths)))
        precision[np.diag_indices_from(precision)] += priors
        scale = 1.0 / np.sqrt(np.diag(precision))
        factor = np.linalg.cholesky(precision * np.outer(scale, scale))
        inverse = np.linalg.inv(factor)
        covariance = inverse.T @ inverse * np.outer(scale, scale)
        determinant = 2.0 * float(np.log(np.diag(factor)).sum() - np.log(scale).sum())
        return np.exp(-2.0 * logs[0]) * covariance @ self._moment, covariance, determinant

    def minus_log(self, logs: Array) -> tuple[float, Array]:
        """Minus the log evidence and prior of noise and sizes, and its slope."""
        mean, covariance, determinant = self._solved(logs)
        x_count, noise = len(self._x_precision), np.exp(2.0 * logs[0])
        weights, variances = mean[x_count:], np.diag(covariance)[x_count:]
        squares = np.array([float(weights[s] @ weights[s]) for s in self._slices])
        traces = np.array([float(variances[s].sum()) for s in self._slices])
        sizes = np.exp(2.0 * logs[1:])
        left = max(self._power - 2.0 * float(mean @ self._moment) + float(mean @ self._gram @ mean), 0.0)
        off = (logs - self._usual) / self._spread
        prior = float(self._x_precision @ mean[:x_count] ** 2) + float((squares / sizes).sum())
        value = 0.5 * (
            left / noise
            + prior
            + determinant
            + 2.0 * self._count * logs[0]
            + 2.0 * float(self._widths @ logs[1:])
            + float(off @ off)
        )
        by_noise = self._count - (left + float(np.sum(self._gram * covariance))) / noise
        by_size = self._widths - (squares + traces) / sizes
        return value, np.concatenate(([by_noise], by_size)) + off / self._spread
