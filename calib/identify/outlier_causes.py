"""The probable cause of an outlier, if exactly one fits its residual."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, norms

ALIKE = 4.0  # noise standard deviations within which two positions are equal
LEAST_SLIP_rad = 1e-3
NOT_SEATED_m = 0.006  # a badly seated tip is at most this far from its cavity


@dataclass(frozen=True, slots=True)
class OutlierCause:
    """A wrong `cavity`, an encoder of `joint` slipped by `slip_rad`, or (`is_near`) a badly seated tip."""

    cavity: str = ""
    joint: int = 0
    slip_rad: float = 0.0
    is_near: bool = False

    @property
    def words(self) -> str:
        """Text such as `: the tip was probably in cavity 7`; empty if no single cause fits."""
        if self.cavity:
            return f": the tip was probably in cavity {self.cavity}"
        if self.joint:
            angle = math.degrees(self.slip_rad)
            return f": the encoder of joint {self.joint} probably slipped by {angle:+.2f} deg in this pose"
        return ": the tip was probably not seated, or the camera misread it" if self.is_near else ""


def cause_of(
    problem: ArmProblem, x: Array, row: int, deleted_m: Array, noise_m: float, cavities: Mapping[str, Array]
) -> OutlierCause:
    """The cause of a row whose reference minus tip is `deleted_m` (3,)."""
    near = ALIKE * noise_m
    cavity = _other_cavity(problem, x, row, deleted_m, near, cavities)
    if cavity:
        return OutlierCause(cavity=cavity)
    joints = _slipped_joints(problem, x, row, deleted_m, near)
    if len(joints) == 1:
        return OutlierCause(joint=joints[0][0], slip_rad=joints[0][1])
    return OutlierCause(is_near=bool(np.linalg.norm(deleted_m) < NOT_SEATED_m))


def _other_cavity(
    problem: ArmProblem, x: Array, row: int, deleted_m: Array, near_m: float, cavities: Mapping[str, Array]
) -> str:
    """The cavity at the arm's tip; empty if there is none, or more than one."""
    observed = problem.observed
    if not observed.point:
        return ""
    same = [k for k in range(len(observed)) if observed.frame[k] == observed.frame[row]]
    if observed.setup:
        same = [k for k in same if observed.setup[k] == observed.setup[row]]
    places = {observed.point[k]: observed.position_m[k] for k in same if k != row}
    if observed.frames[observed.frame[row]].name != "base":
        places |= {name: np.asarray(place) for name, place in cavities.items()}
    places.pop(observed.point[row], None)
    if not places:
        return ""
    rotation = problem.solution(x).frames[observed.frame[row]].rotation
    sat_at = observed.position_m[row] - rotation.T @ deleted_m
    distances = norms(np.array(list(places.values())) - sat_at)
    order = np.argsort(distances)
    away = float(np.linalg.norm(deleted_m))
    reach = max(near_m, 0.05 * away)
    if distances[order[0]] > reach or (len(order) > 1 and distances[order[1]] < 2.0 * reach):
        return ""
    return list(places)[int(order[0])]


def _slipped_joints(
    problem: ArmProblem, x: Array, row: int, deleted_m: Array, near_m: float
) -> list[tuple[int, float]]:
    """Joints of which a change of the angle alone moves the tip to the reference: (joint, change)."""
    solution = problem.solution(x)
    q = problem.observed.q_rad[row : row + 1]
    found = []
    for joint in range(q.shape[1]):
        angle = 0.0
        for _ in range(4):
            turned = q.copy()
            turned[0, joint] += angle
            slopes = problem.model.slopes(solution.dh, turned, solution.tool_m)
            here = slopes.by_dh[0, :, problem.model.theta_places[joint]]
            missing = deleted_m + problem.model.tips(solution.dh, q, solution.tool_m)[0] - slopes.tips[0]
            angle += float(here @ missing) / max(float(here @ here), 1e-12)
        turned = q.copy()
        turned[0, joint] += angle
        moved = problem.model.tips(solution.dh, turned, solution.tool_m)[0]
        left = deleted_m - (moved - problem.model.tips(solution.dh, q, solution.tool_m)[0])
        if np.linalg.norm(left) < near_m and abs(angle) > LEAST_SLIP_rad:
            found.append((joint + 1, angle))
    return found
