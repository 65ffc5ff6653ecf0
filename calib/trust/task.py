"""The probability that a task is met: that a whole path stays within a tolerance, by draws of the arm from the posterior.

One draw is one arm that the poses allow: its geometry by the full kinematics, what the geometry lacks, and the scatter of
one run. The path is met if no pose of it is further off than the tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arrays import Array
from calib.trust.discrepancy import Conditions
from calib.trust.prediction import Predictor
from calib.validation.statistics import proportion
from control.dynamics.static_pose import moving_Nm
from control.errors import MissingModel
from control.model.arm import Arm
from control.motion.plan import PlannedPath, plan_path
from control.motion.waypoints import Waypoints

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
