"""What the look at static poses found, with what its report draws."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, Mask
from calib.gap.drawn_law import DrawnLaw
from calib.gap.effects.frame import FRAME
from calib.gap.finding import GapFinding
from calib.gap.poses.floor import Floor
from calib.gap.poses.recordings import Split
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
