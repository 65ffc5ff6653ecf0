"""What a mock motion capture system sees: a body at the tip, one on the arm's base, and one that stands aside.

The system's frame is anywhere: a point of the base frame is at turn' (p - place) in it.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from hil_mocks.devices.camera import CameraSetup, Filmed, PictureMock, Point, TipPose

Array = NDArray[np.float64]
BASE_m, BASE_turn_rad = (-0.12, 0.08, 0.05), (0.3, -0.2, 0.9)  # of the body on the base, in the base frame
ASIDE_m, ASIDE_turn_rad = (0.3, -0.6, 0.2), (0.0, 0.4, 0.1)
TARGET_turn_rad = (0.5, -0.3, 0.2)  # of the body at the tip, on the last link
ASIDE = "wand"


@dataclass(frozen=True, slots=True)
class SceneSetup:
    """Names of the bodies (base: may be empty), place of the system's frame in the base frame, noise of orientations."""

    body: str
    base_body: str
    place_m: Point
    turn_rad: Point
    turn_noise_rad: float


@dataclass(frozen=True, slots=True)
class Sight:
    """A body in the system's frame: position (3,) [m], rotation (3, 3) of its axes."""

    name: str
    position_m: Array
    rotation: Array
    is_visible: bool


def rotation_of(vector_rad: Point) -> Array:
    """The rotation (3, 3) about a vector by its length."""
    angle = float(np.linalg.norm(vector_rad))
    axis = np.array(vector_rad) / angle if angle > 0.0 else np.array([0.0, 0.0, 1.0])
    quaternion, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(quaternion, axis, angle)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


class MocapMock(PictureMock):
    """Sees bodies; a subclass says them in a vendor's format."""

    has_bodies = True

    def __init__(self, setup: CameraSetup, scene: SceneSetup) -> None:
        super().__init__(setup)
        self.scene = scene
        self._turn, self._place = rotation_of(scene.turn_rad), np.array(scene.place_m)
        self._still = [(ASIDE, np.array(ASIDE_m), rotation_of(ASIDE_turn_rad))]
        if scene.base_body:
            self._still.append((scene.base_body, np.array(BASE_m), rotation_of(BASE_turn_rad)))
        self._number = 0

    @property
    def names(self) -> list[str]:
        """All bodies, in the order in which they are sent."""
        return [self.scene.body, *(name for name, _, _ in self._still)]

    def picture(self, time_s: float, arm: Filmed) -> bytes:
        """A packet of the vendor's format."""
        self._number += 1
        return self.packet(self._number, time_s, self._sights(arm.tip_pose()))

    @abstractmethod
    def packet(self, number: int, time_s: float, sights: list[Sight]) -> bytes:
        """A frame in the vendor's format."""

    def _sights(self, tip: TipPose) -> list[Sight]:
        is_visible = self.random.random() >= self.setup.dropout
        place, axes = tip
        target = np.array(axes).T @ rotation_of(TARGET_turn_rad)
        sights = [self._sight(self.scene.body, np.array(place), target, is_visible)]
        sights += [self._sight(name, at, turn, True) for name, at, turn in self._still]
        if self.is_exchanged:
            first, second, *others = sights
            sights = [
                Sight(first.name, second.position_m, second.rotation, second.is_visible),
                Sight(second.name, first.position_m, first.rotation, first.is_visible),
                *others,
            ]
        return sights

    def _sight(self, name: str, place_m: Array, rotation: Array, is_visible: bool) -> Sight:
        noise_m, turn_rad = self.setup.noise_m, self.scene.turn_noise_rad
        shake = rotation_of(self._gauss(turn_rad))
        seen_m = self._turn.T @ (place_m - self._place) + self._gauss(noise_m)
        return Sight(name, seen_m, shake @ self._turn.T @ rotation, is_visible)

    def _gauss(self, sd: float) -> Point:
        source = self.random
        return source.gauss(0.0, sd), source.gauss(0.0, sd), source.gauss(0.0, sd)
