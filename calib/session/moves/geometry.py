"""Forward and inverse kinematics of the nominal arm for a session."""

from __future__ import annotations

from collections.abc import Sequence

from calib.session.moves.ports import Vector
from control.kinematics.inverse import InverseKinematics
from control.model.arm import Arm


class ArmGeometry:
    """`calib.session.moves.ports.Geometry` of an arm."""

    def __init__(self, arm: Arm) -> None:
        self._inverse = InverseKinematics(arm)
        self._rest = arm.rest.q_rad if arm.rest is not None else None

    def tip(self, q_rad: Sequence[float]) -> Vector:
        """Tip [m] in the base frame by the arm's own model."""
        return self._inverse.kinematics.tip(*q_rad)

    def nearest(self, point: Vector, q_near: Sequence[float]) -> Sequence[float]:
        """Joint angles within the limits for a tip position; ArmError if there are none."""
        return self._inverse.nearest(point, q_near)

    def posture(self, q_rad: Sequence[float]) -> Sequence[float]:
        """Where the arm is; for an arm without named branches its rest pose, whatever a hand has made of its free joints."""
        return q_rad if self._inverse.has_branches or self._rest is None else self._rest
