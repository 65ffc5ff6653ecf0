"""The pose of a body that stands still, averaged: a milliradian of its noise is half a millimetre at a tip half a metre away."""

from __future__ import annotations

import math

from firmware_iface.mocap.bodies import RigidPose

FRAMES = 500  # whose mean it is, some seconds
MOVED_m, MOVED = (
    0.01,
    0.02,
)  # from the mean; of a quaternion's components, some 2 degrees: it was moved, and the mean begins anew


class SteadyPose:
    """Mean of the newest poses of one body."""

    def __init__(self) -> None:
        self._count, self._mean = 0, RigidPose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))

    def after(self, pose: RigidPose) -> RigidPose:
        """The mean, with one pose more."""
        place, q = pose.position_m, pose.quaternion
        if sum(a * b for a, b in zip(q, self._mean.quaternion, strict=True)) < 0.0:
            w, x, y, z = q
            q = (-w, -x, -y, -z)
        has_moved = (
            math.dist(place, self._mean.position_m) > MOVED_m or math.dist(q, self._mean.quaternion) > MOVED
        )
        self._count = 1 if has_moved else min(self._count + 1, FRAMES)
        share = 1.0 / self._count
        x, y, z = (m + share * (v - m) for m, v in zip(self._mean.position_m, place, strict=True))
        turned = [m + share * (v - m) for m, v in zip(self._mean.quaternion, q, strict=True)]
        length = math.hypot(*turned)
        a, b, c, d = (value / length for value in turned)
        self._mean = RigidPose((x, y, z), (a, b, c, d))
        return self._mean
