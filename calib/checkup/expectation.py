"""What an arm's earlier points say of new poses: where the tip will be measured if nothing has changed, and how surely."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.assembly import Choice, problem_of
from calib.arrays import Array, Mask
from calib.points.points import Points, joined
from calib.trust.discrepancy import Conditions, Discrepancy
from calib.trust.posterior import linearised, loose_play_m2, posterior_of
from control.dynamics.static_pose import resting
from control.errors import MissingModel
from control.model.arm import Arm

LOAD_LEAST_Nm: Final = (
    0.01  # a joint that gravity loads by less, such as a vertical one, tells nothing of its give
)


@dataclass(frozen=True, slots=True)
class Expectation:
    """At m new poses: `left_m` (m, 3), measured minus expected tips; covariance (3 m, 3 m) if nothing has changed.

    scatter_m2 (m, 3, 3): its part that is another in each visit. by_joint (m, 3, n): the tip per angle; by_link (m, 3, 4 links):
    per DH parameter. flank (m, n): the side on which a gear lies, 0 if unclear. load, held (m, n): gravity torque, and what the
    motor holds beyond it, over the largest gravity torque.
    """

    left_m: Array
    covariance: Array
    scatter_m2: Array
    by_joint: Array
    by_link: Array
    tip_m: Array
    flank: Array
    load: Array
    held: Array
    q_rad: Array
    model: ArmModel
    dh: Array
    tool_m: Array

    def turned_m(self, joint: int, angle_rad: float) -> Array:
        """The tip's shift (m, 3) if a joint (0-based) turns by an angle of any size."""
        q = self.q_rad.copy()
        q[:, joint] += angle_rad
        return self.model.tips(self.dh, q, self.tool_m) - self.tip_m

    def __len__(self) -> int:
        """How many poses."""
        return len(self.left_m)

    def chosen(self, rows: list[int]) -> Expectation:
        """Of some poses."""
        flat = (3 * np.array(rows)[:, None] + np.arange(3)).ravel()
        return replace(
            self,
            left_m=self.left_m[rows],
            covariance=self.covariance[np.ix_(flat, flat)],
            scatter_m2=self.scatter_m2[rows],
            by_joint=self.by_joint[rows],
            by_link=self.by_link[rows],
            tip_m=self.tip_m[rows],
            flank=self.flank[rows],
            load=self.load[rows],
            held=self.held[rows],
            q_rad=self.q_rad[rows],
        )


def expectation_of(arm: Arm, earlier: Points, new: Points) -> Expectation:
    """By the posterior of the `earlier` points (`calib.trust.posterior`). UnusablePointsError for a pose without a reference."""
    points = joined((earlier, new))
    problem = problem_of(arm, points, Choice().for_points(arm, points))
    is_new = np.arange(len(points)) >= len(earlier)
    at = Conditions.recorded(arm, points)
    discrepancy = Discrepancy(arm)
    found = posterior_of(problem, at, discrepancy, ~is_new)
    design, wanted = linearised(problem, at, discrepancy, found.x)
    solved = problem.solution(found.x)
    rows = design[is_new]
    flat = rows.reshape(-1, rows.shape[2])
    scatter = loose_play_m2(discrepancy, at, solved, found)[is_new] + found.noise_m**2 * np.eye(3)
    model = ArmModel(arm)
    slopes = model.slopes(solved.dh, new.q_rad, solved.tool_m)
    flank, load, held = _gears(arm, at, is_new)
    return Expectation(
        left_m=rows @ found.mean - wanted[is_new],
        covariance=flat @ found.covariance @ flat.T + _blocks(scatter),
        scatter_m2=scatter,
        by_joint=slopes.by_dh[:, :, list(model.theta_places)],
        by_link=np.asarray(slopes.by_dh),
        tip_m=slopes.tips,
        flank=flank,
        load=load,
        held=held,
        q_rad=new.q_rad,
        model=model,
        dh=solved.dh,
        tool_m=solved.tool_m,
    )


def _gears(arm: Arm, at: Conditions, is_new: Mask) -> tuple[Array, Array, Array]:
    """Flanks, gravity torques and held torques at the new poses, (m, n) each."""
    try:
        state = resting(arm, at.q_rad, at.direction, at.current_A, at.payload_kg)
    except MissingModel:
        unknown = np.zeros((int(is_new.sum()), at.q_rad.shape[1]))
        return np.sign(at.direction)[is_new], unknown, unknown
    largest = np.abs(state.gravity_Nm).max(axis=0)
    unit = np.where(largest > LOAD_LEAST_Nm, largest, np.inf)
    return state.flank[is_new], (state.gravity_Nm / unit)[is_new], (state.held_Nm / unit)[is_new]


def _blocks(parts: Array) -> Array:
    """Block-diagonal matrix (3 m, 3 m) of parts (m, 3, 3)."""
    whole = np.zeros((3 * len(parts), 3 * len(parts)))
    for k, part in enumerate(parts):
        whole[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = part
    return whole
