"""Interfaces of a session to the arm, the hand that seats the tip, and the camera. The runtime implements them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Sample:
    """Averaged encoders and motor currents, one value per joint.

    q_rad and its scatter q_sd_rad; current_A of the motors; direction: sign of each joint's last motion, 0
    unknown; temperature_C of the drives, empty if not measured.
    """

    q_rad: tuple[float, ...]
    q_sd_rad: tuple[float, ...]
    current_A: tuple[float, ...]
    direction: tuple[int, ...]
    temperature_C: tuple[float, ...] = ()


class ArmPort(Protocol):
    """The arm, as moved and read by a session. Every call returns when it is complete."""

    def now_s(self) -> float:
        """Time of the session's clock."""

    def move_to_q(self, q_rad: Sequence[float]) -> None:
        """Move to joint angles and stop there."""

    def release(self) -> None:
        """Release the arm for hand guiding: drives off, without dropping it."""

    def hold(self) -> None:
        """Hold the present position by the drives."""

    def average(self, duration_s: float) -> Sample:
        """Mean of encoders and currents over the next duration_s."""


class JogPort(ArmPort, Protocol):
    """An arm that can also be jogged."""

    def creep_to_q(self, q_rad: Sequence[float]) -> None:
        """Move slowly to nearby joint angles and stop there."""


class TipSeat(Protocol):
    """The hand that seats the tip: the operator's, or the mock hand."""

    def grip(self) -> None:
        """Return when the hand has the arm, so that the drives may let it go."""

    def seat(self, point_m: Vector) -> None:
        """Return when the tip is seated in the cavity at point_m (base frame)."""

    def let_go(self) -> None:
        """The hand is off the arm."""


@dataclass(frozen=True, slots=True)
class SeenTip:
    """Mean tip that a camera saw, its standard deviation per axis, and the orientation of its target (w, x, y, z) if measured."""

    tip_m: Vector
    sd_m: Vector
    orientation: tuple[float, float, float, float] | None = None


class Camera(Protocol):
    """A device that measures the tip, in the base frame or in its own (SessionPlan.pose_frame)."""

    def measure(self, duration_s: float) -> SeenTip:
        """Mean over duration_s."""


class Geometry(Protocol):
    """The arm's nominal geometry; implemented by `calib.session.moves.geometry`."""

    def tip(self, q_rad: Sequence[float]) -> Vector:
        """Tip [m] in the base frame."""

    def nearest(self, point: Vector, q_near: Sequence[float]) -> Sequence[float]:
        """Joint angles for a tip position, on the branch nearest to q_near; ArmError if there are none."""

    def posture(self, q_rad: Sequence[float]) -> Sequence[float]:
        """Posture near which an arm at q_rad approaches a point."""
