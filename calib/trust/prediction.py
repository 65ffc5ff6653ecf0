"""Which arms the points allow, and how far each of them puts the tip off: the posterior, and its error anywhere."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from calib.arm_problem.arm_model import ArmModel, dh_names, prior_sd
from calib.arm_problem.observations import cross_matrix
from calib.arm_problem.problem import TOOL_NAMES, ArmProblem, ModelValues
from calib.arrays import Array
from calib.trust.discrepancy import Conditions, Discrepancy
from calib.validation.statistics import proportion
from control.dynamics.static_pose import moving_Nm
from control.errors import MissingModel
from control.model.arm import Arm
from control.motion.plan import PlannedPath, plan_path
from control.motion.waypoints import Waypoints

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


def posterior_of(problem: ArmProblem, at: Conditions, discrepancy: Discrepancy, used: Mask | None = None) -> Posterior:
    """The posterior of the poses `at` that `problem` holds; of the rows `used` (m,) alone, if given."""
    rows = np.ones(len(problem), dtype=bool) if used is None else used
    x = np.zeros(len(problem.parameters))
    variance = prior_sd(problem.parameters, math.sqrt(UNIFORM), 1.0) ** 2
    logs: Array | None = None
    loose_m2 = np.zeros((len(problem), 3, 3))
    for _ in range(ROUNDS):
        design, wanted = linearised(problem, at, discrepancy, x)
        if logs is not None:
            design, wanted = _weighted(design, wanted, np.exp(-2.0 * logs[0]) * loose_m2)
        evidence = SizeEvidence(design[rows], wanted[rows], variance, discrepancy)
        logs = evidence.best(logs)
        posterior = evidence.posterior(logs)
        x = np.clip(posterior.x, -1.0 * _limits(problem), _limits(problem))
        odds, flank = _weighed(problem, at, discrepancy, posterior, rows)
        discrepancy, at = discrepancy.knowing(odds), replace(at, flank=flank)
        loose_m2 = loose_play_m2(discrepancy, at, problem.solution(x), posterior)
    return evidence.over_sizes(posterior)


def _weighed(
    problem: ArmProblem, at: Conditions, discrepancy: Discrepancy, posterior: Posterior, rows: Mask
) -> tuple[Array, Array | None]:
    """What the rows say about the shares of friction, and about their own flanks, given the play that the posterior expects."""
    design, wanted = linearised(problem, at, discrepancy, posterior.x)
    solved = problem.solution(posterior.x)
    plays = discrepancy.plays_rad(at, posterior.mean[posterior.x_count :])
    moves_m = discrepancy.by_play(at, solved.dh, solved.tool_m) * plays[:, None, :]
    left_m = design @ posterior.mean - wanted
    return discrepancy.weighed(at, left_m * rows[:, None], moves_m * rows[:, None, None], posterior.noise_m)


def linearised(problem: ArmProblem, at: Conditions, discrepancy: Discrepancy, x: Array) -> tuple[Array, Array]:
    """Rows A (m, 3, k) and right-hand sides (m, 3) with A z = rhs + noise, around unknowns x."""
    residuals, jacobian = problem.residuals_and_jacobian(x)
    solved = problem.solution(x)
    columns = discrepancy.columns(at, solved.dh, solved.tool_m)
    return np.concatenate((jacobian, -columns), axis=2), np.asarray(jacobian @ x - residuals)


def loose_play_m2(discrepancy: Discrepancy, at: Conditions, solved: ModelValues, posterior: Posterior) -> Array:
    """Covariance of the tip (m, 3, 3) by gears that lie anywhere in their play."""
    plays = discrepancy.plays_rad(at, posterior.mean[posterior.x_count :])
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

    def over_sizes(self, posterior: Posterior) -> Posterior:
        """The same, averaged over what the poses leave open of each source's size, the others at their most probable ones.

        The most probable size of a source that the poses hardly show is far below what it may be, which matters where they did
        not go. Another size changes the precision of the source's weights f alone, by d: the covariance C becomes
        C - C_f M C_f', the mean m - C_f M m_f, with M = (1 + d C_ff)^-1 d, and twice the logarithm of the evidence falls by
        log det(1 + d C_ff) + n log(size^2 ratio) + m_f' M m_f. The mean of these normal distributions over a grid of sizes is
        matched by its first two moments; no covariance becomes smaller by it.
        """
        mean, covariance = posterior.mean.copy(), posterior.covariance.copy()
        logs = np.log(np.concatenate(([posterior.noise_m], posterior.sizes)))
        for k, part in enumerate(self._slices, start=1):
            rows = slice(part.start + posterior.x_count, part.stop + posterior.x_count)
            here, weights = posterior.covariance[rows, rows], posterior.mean[rows]
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
            wider = posterior.covariance[:, rows] @ (vectors * np.sqrt(np.maximum(values, 0.0)))
            covariance += wider @ wider.T
            mean -= posterior.covariance[:, rows] @ usual @ weights
        return replace(posterior, mean=mean, covariance=covariance)

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
        misfit = max(self._power - 2.0 * float(mean @ self._moment) + float(mean @ self._gram @ mean), 0.0)
        off = (logs - self._usual) / self._spread
        prior = float(self._x_precision @ mean[:x_count] ** 2) + float((squares / sizes).sum())
        value = 0.5 * (
            misfit / noise
            + prior
            + determinant
            + 2.0 * self._count * logs[0]
            + 2.0 * float(self._widths @ logs[1:])
            + float(off @ off)
        )
        by_noise = self._count - (misfit + float(np.sum(self._gram * covariance))) / noise
        by_size = self._widths - (squares + traces) / sizes
        return value, np.concatenate(([by_noise], by_size)) + off / self._spread


# The tip's predicted error at any pose: expected, uncertain and scattering parts; and whether a path keeps a tolerance.


@dataclass(frozen=True, slots=True)
class TipError:
    """The tip's error at m poses, true minus modelled, in the base frame.

    expected_m (m, 3): its mean, which the arm's file does not correct. systematic_m2 (m, 3, 3): covariance of what stays the
    same from visit to visit. random_m2 (m, 3, 3): of what does not.
    """

    tip_m: Array
    expected_m: Array
    systematic_m2: Array
    random_m2: Array

    @property
    def total_m2(self) -> Array:
        """Covariance of one visit about the expected error, (m, 3, 3)."""
        return np.asarray(self.systematic_m2 + self.random_m2)

    @property
    def rms_m(self) -> Array:
        """Root mean square distance of one visit, (m,)."""
        squares = np.einsum("mi,mi->m", self.expected_m, self.expected_m)
        return np.asarray(np.sqrt(squares + np.trace(self.total_m2, axis1=1, axis2=2)))


class Predictor:
    """Predicts errors of an arm from the posterior of its poses. `reference_q` (w, n) spans its workspace."""

    def __init__(
        self, arm: Arm, problem: ArmProblem, discrepancy: Discrepancy, posterior: Posterior, repeat_m: float, reference_q: Array
    ) -> None:
        """`repeat_m`: standard deviation of one axis from visit to visit, without the measurement's noise."""
        self._arm, self._discrepancy, self.posterior = arm, discrepancy, posterior
        self._model, self._solved = ArmModel(arm), problem.solution(posterior.x)
        known = {name: k for k, name in enumerate((*dh_names(len(arm.links)), *TOOL_NAMES))}
        names = [parameter.name for parameter in problem.parameters]
        self.own_places = [k for k, name in enumerate(names) if name in known]
        self._places = [known[names[k]] for k in self.own_places]
        self._scale = problem.scale[self.own_places]
        self.repeat_m, self._reference_q = repeat_m, reference_q
        self.is_tied = _is_tied(problem)

    def at(self, poses: Conditions) -> TipError:
        """The error at poses."""
        columns, tips = self.columns(poses), self._model.tips(self._arm.dh, poses.q_rad)
        spread = np.einsum("mik,kl,mjl->mij", columns, self.posterior.covariance, columns, optimize=True)
        return TipError(tips, self.expected_m(poses, columns), spread, self.scatter_m2(poses))

    def columns(self, poses: Conditions) -> Array:
        """The error's derivatives by the posterior's unknowns (m, 3, k).

        Without a rigid motion of the workspace, if the base is not tied.
        """
        columns = self._raw_columns(poses)
        return columns if self.is_tied else columns - self._moved(poses.q_rad, self._moves)

    def expected_m(self, poses: Conditions, columns: Array) -> Array:
        """The mean error (m, 3): geometry by the full kinematics, the rest linear."""
        linear = columns @ self.posterior.mean
        geometry = self._geometry_columns(poses) @ self.posterior.mean[self.own_places]
        solved = self._solved
        bend = self._model.tips(solved.dh, poses.q_rad, solved.tool_m) - self._model.tips(self._arm.dh, poses.q_rad)
        return np.asarray(linear + (bend - geometry if self.is_tied else 0.0))

    def _geometry_columns(self, poses: Conditions) -> Array:
        slopes = self._model.slopes(self._solved.dh, poses.q_rad, self._solved.tool_m)
        return np.concatenate((slopes.by_dh, slopes.by_tool), axis=2)[:, :, self._places] * self._scale

    def _raw_columns(self, poses: Conditions) -> Array:
        x_count = self.posterior.x_count
        whole = np.zeros((len(poses), 3, len(self.posterior.mean)))
        whole[:, :, self.own_places] = self._geometry_columns(poses)
        whole[:, :, x_count:] = self._discrepancy.columns(poses, self._solved.dh, self._solved.tool_m)
        return whole

    @cached_property
    def _moves(self) -> Array:
        """The rigid motion (6, k) that is nearest to each column over the workspace."""
        reference = Conditions.of(self._reference_q)
        wanted = self._raw_columns(reference).reshape(-1, len(self.posterior.mean))
        found, *_ = np.linalg.lstsq(self._twists(self._reference_q).reshape(-1, 6), wanted)
        return np.asarray(found)

    def _moved(self, q_rad: Array, moves: Array) -> Array:
        return np.asarray(np.einsum("mij,jk->mik", self._twists(q_rad), moves))

    def _twists(self, q_rad: Array) -> Array:
        """Displacement of the tip by small motions of the base, (m, 3, 6)."""
        tips = self._model.tips(self._arm.dh, q_rad)
        return np.array([np.hstack((np.eye(3), -cross_matrix(tip))) for tip in tips])

    def scatter_m2(self, poses: Conditions) -> Array:
        """Covariance (m, 3, 3) of what differs from visit to visit: repeatability, loose gears, encoder steps."""
        return self.seated_m2(poses) + loose_play_m2(self._discrepancy, poses, self._solved, self.posterior)

    def seated_m2(self, poses: Conditions) -> Array:
        """The same for gears that lie on their flanks."""
        slopes = self._model.slopes(self._arm.dh, poses.q_rad)
        by_joint = slopes.by_dh[:, :, list(self._model.theta_places)]
        steps = by_joint * encoder_steps_rad(self._arm) / math.sqrt(12.0)
        return np.asarray(np.einsum("mik,mjk->mij", steps, steps) + self.repeat_m**2 * np.eye(3))

    def drawn_play_m(self, poses: Conditions, drawn: Array, rng: np.random.Generator) -> Array:
        """Displacement of the tip (d, m, 3) by gears whose flank is unclear, of each of the posterior's draws (d, k)."""
        by_play = self._discrepancy.by_play(poses, self._solved.dh, self._solved.tool_m)
        plays = self._discrepancy.plays_rad(poses, drawn[:, self.posterior.x_count :])
        strayed = self._discrepancy.strayed(poses, len(drawn), rng)
        return np.asarray(np.einsum("mij,dmj->dmi", by_play, strayed * plays, optimize=True))


def _is_tied(problem: ArmProblem) -> bool:
    """Whether some pose's reference is known in the arm's base frame."""
    is_free = np.array([frame.is_free for frame in problem.observed.frames])
    return bool((~is_free)[problem.observed.frame].any())


def encoder_steps_rad(arm: Arm) -> Array:
    """One count of each encoder at its joint (n,); 0 of a joint without a drive."""
    steps = np.zeros(arm.joint_count)
    for drive in arm.drives:
        steps[drive.joint - 1] = 2.0 * math.pi / drive.counts_per_joint_turn
    return steps


# The probability that a task is met: that a whole path stays within a tolerance, by draws of the arm from the posterior.
#
# One draw is one arm that the poses allow: its geometry by the full kinematics, what the geometry lacks, and the scatter of
# one run. The path is met if no pose of it is further off than the tolerance.

DRAWS: Final = 2000
SAMPLES_MOST: Final = 200  # poses of a path; its error is smooth


@dataclass(frozen=True, slots=True)
class Reliability:
    """A task: `met` of `draws` arms kept the tolerance [m]; largest_m (draws,) is each arm's largest error on the path.

    worst_time_s: where the error is largest on average.
    """

    tolerance_m: float
    draws: int
    met: int
    largest_m: Array
    worst_time_s: float
    duration_s: float

    @property
    def probability(self) -> float:
        """That the task is met."""
        return self.met / self.draws

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the probability for this number of draws (Wilson 1927)."""
        found = proportion(self.met, self.draws)
        return found.lower, found.upper


@dataclass(frozen=True, slots=True)
class Path:
    """A planned path as poses: times_s (m,), and how each is reached."""

    times_s: Array
    poses: Conditions


def planned(arm: Arm, waypoints: Waypoints, payload_kg: float = 0.0) -> Path:
    """The path as `armwright run` plans it for this arm. PathError if the arm cannot run it."""
    return sampled(arm, plan_path(arm, waypoints), payload_kg)


def sampled(arm: Arm, path: PlannedPath, payload_kg: float = 0.0, count: int = SAMPLES_MOST) -> Path:
    """Poses all along a planned path. Its first and last pose count as moving, as the ones beside them do."""
    times = np.linspace(0.0, path.duration_s, count)
    states = [path.joints.at(time_s) for time_s in times.tolist()]
    q = np.array([state.q_rad for state in states])
    speed = np.array([state.speed_rad_s for state in states])
    acceleration = np.array([state.acceleration_rad_s2 for state in states])
    payload = np.full(len(q), payload_kg)
    direction = np.sign(speed)
    direction[0], direction[-1] = direction[1], direction[-2]
    try:
        moving = moving_Nm(arm, q, speed, acceleration, payload)
    except MissingModel:
        moving = None
    return Path(times, Conditions(q, direction, payload, None, moving))


def reliability_of(predictor: Predictor, path: Path, tolerance_m: float) -> Reliability:
    """Of `planned` paths."""
    columns = predictor.columns(path.poses)
    expected = predictor.expected_m(path.poses, columns)
    drawn = predictor.posterior.draws(DRAWS, 0) - predictor.posterior.mean
    scatter = np.linalg.cholesky(predictor.scatter_m2(path.poses) + 1e-18 * np.eye(3))
    rng = np.random.default_rng(1)
    distances = np.empty((DRAWS, len(path.times_s)))
    for k, one in enumerate(drawn):
        error = expected + columns @ one
        error += np.einsum("mij,mj->mi", scatter, np.broadcast_to(rng.standard_normal(3), error.shape))
        distances[k] = np.linalg.norm(error, axis=1)
    largest = distances.max(axis=1)
    worst = float(path.times_s[int(np.argmax(distances.mean(axis=0)))])
    return Reliability(tolerance_m, DRAWS, int((largest <= tolerance_m).sum()), largest, worst, float(path.times_s[-1]))
