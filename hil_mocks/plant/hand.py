"""The mock hand: grips the tip, drags it to a point with limited speed, holds it there, releases it."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import Any, Literal

import mujoco

from hil_mocks.errors import UnreachableError
from hil_mocks.plant.build import PlantModel, PlantOptions
from hil_mocks.plant.effects import BasePose

Point = tuple[float, float, float]
HandState = Literal["away", "dragging", "holding", "cannot reach"]
_SETTLE_S = 0.25  # after which a tip that is still off cannot reach the point
_CANNOT_M = 1e-3


class Hand:
    """A mocap body that a connect constraint ties to the tip. Moves once a tick, never faster than `hand_speed_m_s`."""

    def __init__(self, at: PlantModel, state: Any, options: PlantOptions, base_pose: BasePose) -> None:
        self._base_pose, self._standing = base_pose, at.standing
        self._data, self._tip_site, self._grip, self._mocap = state, at.tip_site, at.grip, at.mocap
        self._model = at.model
        self._speed_m_s, self._noise_m = options.hand_speed_m_s, options.seating_noise_m
        self._random = random.Random(f"hand {options.seed}")
        self._start: Point = (0.0, 0.0, 0.0)
        self._target: Point = (0.0, 0.0, 0.0)
        self._begun_s = self._duration_s = 0.0
        self.state: HandState = "away"
        self.problem = ""

    def seat(self, point_m: Sequence[float]) -> float:
        """Drag the tip to a point (frame of table and camera) with seating noise; returns the duration in s."""
        x, y, z = (float(value) + self._noise() for value in self._base_pose.in_base(point_m))
        x, y, z = self._standing.in_world((x, y, z))
        if not all(map(math.isfinite, (x, y, z))):
            raise UnreachableError(f"hand: cannot seat the tip at {tuple(point_m)}: the coordinates are not finite.")
        mujoco.mj_kinematics(self._model, self._data)
        here = self._data.site_xpos[self._tip_site]
        self._start, self._target = (float(here[0]), float(here[1]), float(here[2])), (x, y, z)
        # The smooth profile below peaks at 1.875 times its mean speed.
        self._duration_s = max(0.1, 1.875 * math.dist(self._start, self._target) / self._speed_m_s)
        self._begun_s = float(self._data.time)
        self._data.mocap_pos[self._mocap] = here
        self._data.eq_active[self._grip] = 1
        self.state, self.problem = "dragging", ""
        return self._duration_s

    def let_go(self) -> None:
        """Release the tip."""
        self._data.eq_active[self._grip] = 0
        self.state = "away"

    @property
    def is_gripping(self) -> bool:
        """Whether the hand has the tip."""
        return self.state in ("dragging", "holding")

    def residual_m(self) -> float:
        """Distance of the tip from the hand."""
        mujoco.mj_kinematics(self._model, self._data)
        return math.dist(self._data.site_xpos[self._tip_site], self._data.mocap_pos[self._mocap])

    def move(self) -> None:
        """Advance by a tick; nothing while away or holding. Releases an unreachable tip, with the reason in `problem`."""
        if self.state != "dragging":
            return
        s = (float(self._data.time) - self._begun_s) / self._duration_s
        if s >= 1.0:
            self._data.mocap_pos[self._mocap] = self._target
            self._arrive()
            return
        blend = s * s * s * (10.0 + s * (6.0 * s - 15.0))
        self._data.mocap_pos[self._mocap] = [a + (b - a) * blend for a, b in zip(self._start, self._target, strict=True)]

    def _arrive(self) -> None:
        if self.residual_m() < _CANNOT_M:
            self.state = "holding"
        elif float(self._data.time) > self._begun_s + self._duration_s + _SETTLE_S:
            off_mm = self.residual_m() * 1e3
            self.let_go()
            place = ", ".join(f"{value:.3f}" for value in self._outside(self._target))
            self.state = "cannot reach"
            self.problem = f"hand: the arm cannot reach ({place}) m: {off_mm:.1f} mm short; the tip was released."

    def _noise(self) -> float:
        return self._random.gauss(0.0, self._noise_m) if self._noise_m > 0.0 else 0.0

    def _outside(self, world_m: Point) -> Point:
        """A point of the physics in the frame of table and camera."""
        return self._base_pose.in_world(self._standing.in_base(world_m))
