"""Detects parallel axes that are tilted against each other in the way that no parameter of their DH rows holds."""

from __future__ import annotations

import numpy as np

from calib.arm_problem.link_bending import link_frames
from calib.arm_problem.parallel_axes import frame_behind, parallel_joints
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array
from calib.identify.linear_fit import LinearFit
from control.model.arm import Arm

CHANCE = 1e-6  # probability of a false alarm
ROWS_LIMIT = 3000  # this many suffice
EXPLAINED_SHARE = 0.05  # of the squared residuals: a smaller tilt is not worth a word


def tilted_axes(arm: Arm, problem: ArmProblem, x: Array) -> list[str]:
    """A sentence for every pair of axes whose tilt would explain a share of the squared residuals."""
    some = problem.of_rows(slice(None, None, -(-len(problem) // ROWS_LIMIT)))
    solution = some.solution(x)
    frames = link_frames(some.model, solution.dh, some.observed.q_rad, solution.tool_m)
    around, said = LinearFit.around(some, x), []
    for joint in parallel_joints(arm):
        frame = frame_behind(arm, joint)
        moved = np.cross(frames.axes[:, frame, :, 1], frames.tip_m - frames.origin_m[:, frame])
        tilt_rad, share, chance = _gained(around, around.weighted(moved[:, :, None]))
        if share > EXPLAINED_SHARE and chance < CHANCE:
            said.append(
                f"the axes of joints {joint} and {joint + 1} may not be parallel: a tilt of {1e3 * abs(tilt_rad):.2f} mrad, which"
                f" their DH rows cannot hold, explains {100.0 * share:.0f} % of the squared residuals; `armwright gap` tells it"
                " from other causes, and writes it to arm.toml"
            )
    return said


def _gained(around: LinearFit, column: Array) -> tuple[float, float, float]:
    """Size of one more unknown, the share of the squares that it explains, and the probability that noise does as much."""
    from scipy.special import fdtrc

    known = around.columns.reshape(-1, around.rank)
    wanted, own = -around.residuals.ravel(), column.ravel()
    wanted, own = (one - known @ (known.T @ one) for one in (wanted, own))
    square, freedom = float(own @ own), len(wanted) - around.rank - 1
    before = float(wanted @ wanted)
    if freedom < 1 or before <= 0.0 or square < 1e-12 * float(column.ravel() @ column.ravel()):
        return 0.0, 0.0, 1.0
    size = float(own @ wanted) / square
    gain = size**2 * square
    return size, gain / before, float(fdtrc(1, freedom, gain * freedom / max(before - gain, 1e-300)))
