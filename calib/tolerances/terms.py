"""The linear parameters of a made arm: DH deviations, the tool, and what joints and links do beside them; tips of many arms.

An arm is a vector z of parameters; all arms of a study share the terms. Joint j turns by q + sum(z_k column_k(q)); links that
bend add z_k shift_k(q) to the tip. The tip itself is that of the full forward kinematics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.link_bending import bending_m
from calib.arm_problem.parameters import dh_names
from calib.arm_problem.problem import TOOL_NAMES
from calib.arrays import Array
from calib.trust.discrepancy import Conditions
from control.dynamics.static_pose import resting
from control.kinematics import chain
from control.model.arm import Arm
from control.model.effect_laws import backlash_rad, compliance_rad

Kind = Literal["scale", "sine", "cosine", "play", "compliance", "bending"]
BY_MASSES: Final = ("play", "compliance", "bending")  # laws of gravity: they need masses in arm.toml


@dataclass(frozen=True, slots=True)
class Term:
    """One parameter beyond geometry: its law, and the joint or link (1-based); `waves` per turn of the joint."""

    kind: Kind
    number: int
    waves: float = 1.0


class MadePoses:
    """Poses of arms that are made of the same terms; z (arms, 4 links + 3 + terms)."""

    def __init__(self, arm: Arm, terms: tuple[Term, ...], at: Conditions) -> None:
        """MissingModel if a term needs masses that the arm's file lacks."""
        self._arm, self._model, self.at = arm, ArmModel(arm), at
        self._dh_count = 4 * len(arm.links)
        self.names = (*dh_names(len(arm.links)), *TOOL_NAMES)
        self._flank, self._gravity_Nm = _gears(arm, terms, at)
        first = len(self.names)
        self._turning = [
            (first + k, one.number - 1, self._column(one))
            for k, one in enumerate(terms)
            if one.kind != "bending"
        ]
        self._bending = [
            (first + k, bending_m(arm, arm.dh, at.q_rad, at.payload_kg, one.number))
            for k, one in enumerate(terms)
            if one.kind == "bending"
        ]
        self._plays = [(first + k, one.number - 1) for k, one in enumerate(terms) if one.kind == "play"]

    def tips(self, z: Array, turned_rad: Array | None = None) -> Array:
        """Tips (3, arms, m) of arms z (arms, k); `turned_rad` (n, arms, m) is added to the joints' angles."""
        q = [angle[None, :] for angle in self.at.q_rad.T]
        for k, j, column in self._turning:
            q[j] = q[j] + z[:, k, None] * column
        if turned_rad is not None:
            q = [angle + more for angle, more in zip(q, turned_rad, strict=True)]
        end = self._dh_count
        rows = (self._arm.dh.ravel() + z[:, :end]).T[:, :, None]
        dh = [list(rows[4 * i : 4 * i + 4]) for i in range(len(self._arm.links))]
        tool = (self._model.nominal_tool_m + z[:, end : end + 3]).T[:, :, None]
        parts = chain.tip(chain.steps(dh, self._arm.joints, self._arm.dh_convention), q, list(tool))
        tips = np.empty((3, len(z), len(self.at)))
        for i, part in enumerate(parts):
            tips[i] = part
        for k, shift_m in self._bending:
            tips += z[:, k, None] * shift_m.T[:, None, :]
        return tips

    def slopes(self, z: Array) -> Array:
        """Derivatives of the tips by z at one arm z (k,): (3, m, k)."""
        q = self.at.q_rad.copy()
        for k, j, column in self._turning:
            q[:, j] += z[k] * column
        end = self._dh_count
        dh, tool = self._arm.dh + z[:end].reshape(-1, 4), self._model.nominal_tool_m + z[end : end + 3]
        found = self._model.slopes(dh, q, tool)
        whole = np.zeros((len(q), 3, len(z)))
        whole[:, :, :end], whole[:, :, end : end + 3] = found.by_dh, found.by_tool
        for k, j, column in self._turning:
            whole[:, :, k] = found.by_dh[:, :, self._model.theta_places[j]] * column[:, None]
        for k, shift_m in self._bending:
            whole[:, :, k] = shift_m
        return np.ascontiguousarray(whole.transpose(1, 0, 2))

    def loose_rad(self, z: Array, places: Array) -> Array:
        """Angles of joints by gears at `places` (n, arms, m; -1 .. 1) of their play, where nothing presses them to a flank."""
        turned = np.zeros(places.shape)
        for k, j in self._plays:
            is_loose = self._flank[:, j] == 0.0
            if is_loose.any():
                turned[j] = 0.5 * z[:, k, None] * places[j] * is_loose
        return turned

    def _column(self, term: Term) -> Array:
        j = term.number - 1
        q = self.at.q_rad[:, j]
        if term.kind == "play":
            return np.asarray(backlash_rad(self._flank[:, j], 1.0))
        if term.kind == "compliance":
            return np.asarray(compliance_rad(self._gravity_Nm[:, j], 1.0))
        if term.kind == "scale":
            return q
        wave = np.sin if term.kind == "sine" else np.cos
        return np.asarray(wave(term.waves * q))


def _gears(arm: Arm, terms: tuple[Term, ...], at: Conditions) -> tuple[Array, Array]:
    """Flanks (0: nothing presses the gear) and gravity torques, (m, n) each."""
    if not any(one.kind in BY_MASSES for one in terms):
        return np.zeros(at.q_rad.shape), np.zeros(at.q_rad.shape)
    state = resting(arm, at.q_rad, at.direction, None, at.payload_kg)
    return state.flank, state.gravity_Nm
