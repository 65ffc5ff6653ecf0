"""What the look at static poses found, with what its report draws."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, Mask
from calib.gap.drawn_law import DrawnLaw
from calib.gap.effects.links import FRAME
from calib.gap.effects.record import NO_TORQUE_Nm
from calib.gap.finding import EffectName, GapFinding
from calib.gap.poses.floor import Floor
from calib.gap.poses.linear import by_joints
from calib.gap.poses.recordings import Split
from calib.gap.poses.state import Around
from calib.gap.posterior.search import Weighed
from calib.gap.posterior.term import Term
from calib.points.points import Points
from control.model.arm import Arm


@dataclass(frozen=True, slots=True)
class StaticGap:
    """The finding, and what its report draws: poses, their split, residuals (m, 3) as the model grows, stage by stage.

    `arm`: as its file has it, with the fixed rows that axes which are not quite parallel ask for; `file`: that of the new file.
    `problem` at its unknowns `x` places that at the poses, `warnings` are sentences about the data and the fit, `left_out` (m,)
    marks poses that no model explains, `load_Nm` (m, n) are gravity's torques (None for an arm without masses).
    """

    arm: Arm
    file: Arm
    finding: GapFinding
    points: Points
    split: Split
    floor: Floor
    stages: tuple[tuple[str, Array], ...]
    problem: ArmProblem
    x: Array
    warnings: tuple[str, ...]
    left_out: Mask
    load_Nm: Array | None
    laws: tuple[DrawnLaw, ...]

    @property
    def fitted_arm(self) -> Arm:
        """The arm with the fitted geometry, and the frame of the tips where nobody knew it: without what else was found."""
        frame = [one for one in self.file.effects if one.effect == FRAME]
        others = [one for one in self.arm.effects if one.effect != FRAME or not frame]
        return dataclasses.replace(self.file, effects=(*others, *frame), maps=())


MILLI = 1e3


def drawn_laws(
    around: Around, best: Weighed, names: Sequence[EffectName], residual_m: Array
) -> tuple[DrawnLaw, ...]:
    """Of the names that move joints, or the tip along one line; residual_m (m, 3): what the whole set leaves."""
    size, _ = around.evidence.estimate(best.members, best.kappa)
    found, first = {}, 0
    by_joint, _ = by_joints(around.state.posed())
    for number, _ in best.members:
        one = around.terms[number]
        own = size[first : first + one.count]
        first += one.count
        if one.key in names and one.variable and (one.slope_rad is not None or one.slope_m is not None):
            found[one.key] = _drawn(around, one, own, by_joint, residual_m)
    return tuple(found[name] for name in names if name in found)


def _drawn(around: Around, one: Term, size: Array, by_joint: Array, residual_m: Array) -> DrawnLaw:
    laws = size * (np.arange(one.count) < one.laws)
    name = one.key
    assert isinstance(name, EffectName)
    at, label = _variable(around, one)
    if one.slope_rad is not None:
        joint = int(np.argmax(np.abs(one.slope_rad).sum(axis=(0, 1))))
        law, whole = (one.slope_rad[:, :, joint].T @ own for own in (laws, size))
        lever, unit = by_joint[:, :, joint], "mrad"
    else:
        assert one.slope_m is not None
        law_m, whole_m = (np.einsum("c,cmi->mi", own, one.slope_m) for own in (laws, size))
        lever = law_m / np.maximum(np.linalg.norm(law_m, axis=1, keepdims=True), 1e-12)
        law, whole, unit = np.linalg.norm(law_m, axis=1), np.einsum("mi,mi->m", whole_m, lever), "mm"
    shown = np.einsum("mi,mi->m", lever, residual_m) / np.maximum(np.einsum("mi,mi->m", lever, lever), 1e-12)
    return DrawnLaw(name, label, unit, at, MILLI * (whole + shown), MILLI * law, MILLI * whole)


def _variable(around: Around, one: Term) -> tuple[Array, str]:
    """The law's own variable at all poses (m,), and its label."""
    points, joint = around.points, getattr(one.key, "joint", None)
    if one.variable.startswith("q") and one.variable[1:].isdigit():
        return np.degrees(points.q_rad[:, int(one.variable[1:]) - 1]), f"{one.variable} [deg]"
    if one.variable == "time":
        return points.elapsed_s, "time [s]"
    if joint is None or joint > points.joint_count:
        return np.arange(len(points), dtype=float), "pose"
    load = around.gravity_Nm()
    if load is not None and float(np.abs(load[:, joint - 1]).max()) > NO_TORQUE_Nm:
        return load[:, joint - 1], f"gravity torque of joint {joint} [N m]"
    return np.degrees(points.q_rad[:, joint - 1]), f"q{joint} [deg]"
