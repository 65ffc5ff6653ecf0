"""control's kinematics in the form that an identification needs: with the DH table as an argument."""

from __future__ import annotations

import numpy as np

from calib.arrays import Array
from control.model import chain
from control.model.arm import Arm
from control.model.chain_jacobian import tips_and_dh_jacobian


class ArmModel:
    """The TipModel of an arm: its joints, DH convention and tool; the DH table is given with every call."""

    def __init__(self, arm: Arm) -> None:
        """Of the arm only the structure is kept; its own DH table is the nominal one of whoever asks."""
        self._joints, self._convention, self._tool_m = arm.joints, arm.dh_convention, arm.tool.position_m

    def tips(self, dh: Array, q: Array) -> Array:
        """Tip positions (m, 3) [m] in the base frame."""
        steps = chain.steps(dh.tolist(), self._joints, self._convention)
        tip = chain.tip(steps, list(q.T), self._tool_m)
        return np.column_stack([np.broadcast_to(np.asarray(part, dtype=float), len(q)) for part in tip])

    def tips_and_dh_jacobian(self, dh: Array, q: Array) -> tuple[Array, Array]:
        """Tips (m, 3) and their derivatives (m, 3, 4 links) with respect to dh.ravel()."""
        return tips_and_dh_jacobian(dh, q, self._joints, self._convention, self._tool_m)
