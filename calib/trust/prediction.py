"""The tip's predicted error at any pose: expected, uncertain and scattering parts; and whether a path keeps a tolerance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.frames import cross_matrix
from calib.arm_problem.parameters import dh_names
from calib.arm_problem.problem import TOOL_NAMES, ArmProblem
from calib.arrays import Array
from calib.trust.discrepancy import Conditions, Discrepancy
from calib.trust.posterior import Posterior, loose_play_m2
from calib.validation.statistics import proportion
from control.dynamics.static_pose import moving_Nm
from control.errors import MissingModel
from control.model.arm import Arm
from control.motion.plan import PlannedPath, plan_path
from control.motion.waypoints import Waypoints


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
        self,
        arm: Arm,
        problem: ArmProblem,
        discrepancy: Discrepancy,
        posterior: Posterior,
        repeat_m: float,
        reference_q: Array,
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
        bend = self._model.tips(solved.dh, poses.q_rad, solved.tool_m) - self._model.tips(
            self._arm.dh, poses.q_rad
        )
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


def reliability_of(predictor: Predictor, path: Path, tolerance_m: float, seed: int = 0) -> Reliability:
    """Of `planned` paths."""
    columns = predictor.columns(path.poses)
    expected = predictor.expected_m(path.poses, columns)
    drawn = predictor.posterior.draws(DRAWS, seed) - predictor.posterior.mean
    scatter = np.linalg.cholesky(predictor.scatter_m2(path.poses) + 1e-18 * np.eye(3))
    rng = np.random.default_rng(seed + 1)
    distances = np.empty((DRAWS, len(path.times_s)))
    for k, one in enumerate(drawn):
        error = expected + columns @ one
        error += np.einsum("mij,mj->mi", scatter, np.broadcast_to(rng.standard_normal(3), error.shape))
        distances[k] = np.linalg.norm(error, axis=1)
    largest = distances.max(axis=1)
    worst = float(path.times_s[int(np.argmax(distances.mean(axis=0)))])
    return Reliability(
        tolerance_m, DRAWS, int((largest <= tolerance_m).sum()), largest, worst, float(path.times_s[-1])
    )
