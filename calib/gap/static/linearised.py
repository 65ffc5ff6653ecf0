"""The arm around its fitted geometry, as whitened columns: what `Evidence` compares effects with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, Mask
from calib.gap.static.candidates import Candidate
from calib.gap.static.evidence import Evidence
from calib.identify.problem import ArmProblem


@dataclass(frozen=True, slots=True)
class Linearised:
    """Around unknowns x of a problem, in standard deviations of the noise: base (3m, k) and values y (3m,).

    by_joint (m, 3, n): how the tip follows each joint [m/rad]; noise_m: of one axis of one pose.
    """

    base: Array
    y: Array
    by_joint: Array
    noise_m: float

    @classmethod
    def around(cls, problem: ArmProblem, x: Array, noise_m: float) -> Linearised:
        """Y = reference - tip as if the unknowns were 0, so that a prior around 0 means what it says."""
        residuals, jacobian = problem.residuals_and_jacobian(x)
        base = -jacobian.reshape(-1, len(x)) / noise_m
        found = problem.solution(x)
        q = problem.observed.q_rad
        by_dh = problem.model.slopes(found.dh, q, found.tool_m).by_dh
        by_joint = by_dh[:, :, list(problem.model.theta_places)]
        return cls(base, residuals.ravel() / noise_m + base @ x, by_joint, noise_m)

    def columns(self, slope_rad: Array) -> Array:
        """What joint slopes (c, m, n) do to the tips, whitened (3m, c)."""
        moved = np.einsum("mij,cmj->cmi", self.by_joint, slope_rad)
        return np.asarray(moved.reshape(len(slope_rad), -1).T / self.noise_m)

    def evidence(self, candidates: Sequence[Candidate], rows: Mask | None = None) -> Evidence:
        """Of every candidate's columns in typical sizes, one after the other; `rows` (m,) chooses poses."""
        columns = np.concatenate([self.columns(c.slope_rad) * c.size for c in candidates], axis=1)
        keep = slice(None) if rows is None else np.repeat(rows, 3)
        return Evidence.of(self.base[keep], columns[keep], self.y[keep])


def places(candidates: Sequence[Candidate]) -> list[list[int]]:
    """Where each candidate's columns stand in the evidence."""
    ends = np.cumsum([len(c.size) for c in candidates])
    return [list(range(end - len(c.size), end)) for c, end in zip(candidates, ends, strict=True)]
