"""What a webcam beside the mock arm sees: a printed target on the last link, at the arm's true pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hil_mocks.plant.geometry import DH_KEYS, Convention, DhLink, rotation_z, true_frame
from hil_mocks.webcam import Grey, PrintedSheet, Webcam

Array = NDArray[np.float64]


class JointLink(DhLink, Protocol):
    """A link of arm.toml."""

    @property
    def joint(self) -> str: ...


@dataclass(frozen=True, slots=True)
class FramePose:
    """A frame in another: rotation (3, 3), position_m (3,)."""

    rotation: Array
    position_m: Array

    def then(self, inner: FramePose) -> FramePose:
        """A frame given in this one, in this one's own parent."""
        return FramePose(self.rotation @ inner.rotation, self.rotation @ inner.position_m + self.position_m)

    @property
    def inverse(self) -> FramePose:
        """The parent in this frame."""
        return FramePose(self.rotation.T, -self.rotation.T @ self.position_m)


@dataclass(frozen=True, slots=True)
class PicturedArm:
    """An arm whose links are off nominal by `deviations` (link1_d_m ...), a target on its last link, a camera beside it.

    grey: the print; width_m: of the print with its margin; last_T_target, base_T_camera.
    """

    links: Sequence[JointLink]
    convention: Convention
    grey: Grey
    width_m: float
    last_T_target: FramePose
    base_T_camera: FramePose
    webcam: Webcam
    deviations: Mapping[str, float] = field(default_factory=dict)

    def target(self, q_rad: Sequence[float]) -> FramePose:
        """The target in the camera's frame at true joint angles."""
        return self.base_T_camera.inverse.then(self.last_link(q_rad)).then(self.last_T_target)

    def last_link(self, q_rad: Sequence[float]) -> FramePose:
        """The last link's frame in the base frame."""
        place, angles = FramePose(np.eye(3), np.zeros(3)), iter(q_rad)
        for number, link in enumerate(self.links, 1):
            off = {key: self.deviations.get(f"link{number}_{key}", 0.0) for key in DH_KEYS}
            frame = true_frame(link, off, self.convention)
            own = FramePose(frame.rotation, frame.position_m)
            if link.joint == "fixed":
                place = place.then(own)
                continue
            turn = FramePose(rotation_z(next(angles)), np.zeros(3))
            place = (
                place.then(turn).then(own) if self.convention == "standard" else place.then(own).then(turn)
            )
        return place

    def picture(self, q_rad: Sequence[float], draw: np.random.Generator) -> Grey:
        """The webcam's picture."""
        place = self.target(q_rad)
        return self.webcam.picture(
            [PrintedSheet(self.grey, self.width_m, place.rotation, place.position_m)], draw
        )


def looking_at(place_m: Array, at_m: Array) -> FramePose:
    """base_T_camera of a camera that looks from one place to another, upright."""
    ahead = (at_m - place_m) / np.linalg.norm(at_m - place_m)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return FramePose(
        np.column_stack((right, np.cross(ahead, right), ahead)), np.asarray(place_m, dtype=float)
    )
