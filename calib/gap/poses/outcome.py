"""What the look at static poses found, with what its report draws."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array
from calib.gap.effects.links import FRAME
from calib.gap.effects.record import NO_TORQUE_Nm
from calib.gap.finding import DrawnLaw, EffectName, GapFinding
from calib.gap.poses.floor import Floor
from calib.gap.poses.linear import Fit, along_joint, by_joints
from calib.gap.poses.recordings import Split
from calib.gap.poses.state import Linearised, Looked
from calib.gap.posterior.evidence import Weighed
from calib.gap.posterior.term import Term
from calib.gap.posterior.told import Told
from calib.points.points import Points
from control.model.arm import Arm


@dataclass(frozen=True, slots=True)
class StaticGap:
    """The finding, and what its report draws: poses, their split, residuals (m, 3) as the model grows, stage by stage.

    `arm`: as its file has it, with the fixed rows that axes which are not quite parallel ask for; `file`: that of the new file.
    `problem` at its unknowns `x` places that at the poses, `warnings` are sentences about the data and the fit, `looked` is what
    was there before any search, `load_Nm` (m, n) are gravity's torques (None for an arm without masses), `told` is what these
    poses tell of the arm's effects.
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
    looked: Looked
    load_Nm: Array | None
    laws: tuple[DrawnLaw, ...]
    told: Told

    @property
    def fitted_arm(self) -> Arm:
        """The arm with the fitted geometry, and the frame of the tips where nobody knew it: without what else was found."""
        frame = [one for one in self.file.effects if one.effect == FRAME]
        others = [one for one in self.arm.effects if one.effect != FRAME or not frame]
        return dataclasses.replace(self.file, effects=(*others, *frame), maps=())

    @property
    def by_joint(self) -> Array:
        """How the tips follow each joint, (m, 3, n)."""
        return by_joints(Fit(self.problem, self.x, None))[0]


def drawn_laws(linearised: Linearised, best: Weighed, names: Sequence[EffectName], residual_m: Array) -> tuple[DrawnLaw, ...]:
    """Each of the names over its own variable, of those that move joints, or the tip along one line; residual_m (m, 3): what the
    whole set leaves.
    """
    drawn, (by_joint, _) = {}, by_joints(linearised.state.posed())
    for number, size in linearised.evidence.sizes(best).items():
        term, laws = linearised.terms[number], size * (np.arange(len(size)) < linearised.terms[number].laws)
        if term.key not in names or not isinstance(term.key, EffectName) or not term.variable:
            continue
        if term.slope_rad is not None:
            joint = int(np.argmax(np.abs(term.slope_rad).sum(axis=(0, 1))))
            law, whole = (term.slope_rad[:, :, joint].T @ coefficients for coefficients in (laws, size))
            lever, unit = by_joint[:, :, joint], "mrad"
        elif term.slope_m is not None:
            law_m, whole_m = (np.einsum("c,cmi->mi", coefficients, term.slope_m) for coefficients in (laws, size))
            lever = law_m / np.maximum(np.linalg.norm(law_m, axis=1, keepdims=True), 1e-12)
            law, whole, unit = np.linalg.norm(law_m, axis=1), np.einsum("mi,mi->m", whole_m, lever), "mm"
        else:
            continue
        at, label = _variable(linearised, term)
        data = whole + along_joint(lever, residual_m)
        drawn[term.key] = DrawnLaw(term.key, label, unit, at, 1e3 * data, 1e3 * law, 1e3 * whole)
    return tuple(drawn[name] for name in names if name in drawn)


def _variable(linearised: Linearised, term: Term) -> tuple[Array, str]:
    """The law's own variable at all poses (m,), and its label."""
    points, joint = linearised.looked.points, getattr(term.key, "joint", None)
    if term.variable.startswith("q") and term.variable[1:].isdigit():
        return np.degrees(points.q_rad[:, int(term.variable[1:]) - 1]), f"{term.variable} [deg]"
    if term.variable == "time":
        return points.elapsed_s, "time [s]"
    if joint is None or joint > points.joint_count:
        return np.arange(len(points), dtype=float), "pose"
    load = linearised.gravity_Nm()
    if load is not None and float(np.abs(load[:, joint - 1]).max()) > NO_TORQUE_Nm:
        return load[:, joint - 1], f"gravity torque of joint {joint} [N m]"
    return np.degrees(points.q_rad[:, joint - 1]), f"q{joint} [deg]"
