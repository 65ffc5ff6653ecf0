"""control's kinematics in the form that an identification needs: DH table and tool as arguments."""

from __future__ import annotations

import numpy as np

from calib.arrays import Array
from control.kinematics import chain
from control.kinematics.chain import TipSlopes, tip_slopes
from control.model.arm import Arm


class ArmModel:
    """The structure of an arm: revolute links, DH convention, nominal DH table and tool."""

    def __init__(self, arm: Arm) -> None:
        """Only the geometry of `arm` is used."""
        self.joints, self._convention = arm.joints, arm.dh_convention
        self.nominal_dh, self.nominal_tool_m = arm.dh, np.array(arm.tool.position_m)

    def tips(self, dh: Array, q: Array, tool_m: Array | None = None) -> Array:
        """Tip positions (m, 3) [m] in the base frame, of DH table (links, 4), poses (m, n), tool (3,)."""
        tool = self.nominal_tool_m if tool_m is None else tool_m
        steps = chain.steps(dh.tolist(), self.joints, self._convention)
        tip = chain.tip(steps, list(q.T), tool.tolist())
        return np.column_stack([np.broadcast_to(np.asarray(part, dtype=float), len(q)) for part in tip])

    def slopes(self, dh: Array, q: Array, tool_m: Array | None = None) -> TipSlopes:
        """Tips and their derivatives by dh.ravel() and by the tool."""
        tool = self.nominal_tool_m if tool_m is None else tool_m
        return tip_slopes(dh, q, self.joints, self._convention, tool.tolist())

    @property
    def is_modified(self) -> bool:
        """Whether L and alpha come before d and theta."""
        return self._convention == "modified"

    @property
    def theta_places(self) -> tuple[int, ...]:
        """Index in dh.ravel() of each joint's theta, whose column is the derivative by the joint angle."""
        return tuple(4 * link + 1 for link, turns in enumerate(self.joints) if turns)
