"""The arm around its fitted geometry, as whitened columns: what `Evidence` compares effects with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, Mask
from calib.gap.poses.candidate import Candidate
from calib.gap.poses.currents import Currents
from calib.gap.poses.evidence import Evidence
from calib.gap.static.signature import Signature


@dataclass(frozen=True, slots=True)
class Linearised:
    """Around unknowns x of a problem, in standard deviations of the noise: base (3m, k) and values y (3m,).

    by_joint (m, 3, n): how the tip follows each joint [m/rad]; noise_m: of one axis of one pose. `currents`: what the motors
    hold, where that is known, as a second witness.
    """

    base: Array
    y: Array
    by_joint: Array
    noise_m: float
    currents: Currents | None = None

    @classmethod
    def around(
        cls, problem: ArmProblem, x: Array, noise_m: float, currents: Currents | None = None
    ) -> Linearised:
        """Y = reference - tip as if the unknowns were 0, so that a prior around 0 means what it says."""
        residuals, jacobian = problem.residuals_and_jacobian(x)
        base = -jacobian.reshape(-1, len(x)) / noise_m
        found = problem.solution(x)
        q = problem.observed.q_rad
        by_dh = problem.model.slopes(found.dh, q, found.tool_m).by_dh
        by_joint = by_dh[:, :, list(problem.model.theta_places)]
        return cls(base, residuals.ravel() / noise_m + base @ x, by_joint, noise_m, currents)

    def columns(self, one: Signature) -> Array:
        """What a signature does to the tips, whitened (3m, c)."""
        moved = np.einsum("mij,cmj->cmi", self.by_joint, one.slope_rad)
        if one.slope_m is not None:
            moved = moved + one.slope_m
        return np.asarray(moved.reshape(len(moved), -1).T / self.noise_m)

    def evidence(self, candidates: Sequence[Candidate], rows: Mask) -> Evidence:
        """Of every candidate's columns in typical sizes, one after the other; `rows` (m,) chooses poses."""
        columns = np.concatenate([self.columns(c) * c.size for c in candidates], axis=1)
        keep = np.repeat(rows, 3)
        seen = Evidence.of(self.base[keep], columns[keep], self.y[keep])
        return seen if self.currents is None else seen.beside(self.currents.evidence(candidates, rows))


def places(candidates: Sequence[Candidate]) -> list[list[int]]:
    """Where each candidate's columns stand in the evidence."""
    ends = np.cumsum([len(c.size) for c in candidates])
    return [list(range(end - len(c.size), end)) for c, end in zip(candidates, ends, strict=True)]
