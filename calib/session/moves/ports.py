"""What a session needs of the arm, of whoever seats the tip, and of the camera. The runtime implements it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Sample:
    """Encoders and motor currents averaged over a while, one value a joint.

    q_rad and its scatter q_sd_rad; current_A of the motors; direction: sign of each joint's last motion, 0
    unknown; temperature_C of the drives, empty where nothing measures it.
    """

    q_rad: tuple[float, ...]
    q_sd_rad: tuple[float, ...]
    current_A: tuple[float, ...]
    direction: tuple[int, ...]
    temperature_C: tuple[float, ...] = ()


class ArmPort(Protocol):
    """The arm, as far as a session moves and reads it. Every call returns when what it says has happened."""

    def now_s(self) -> float:
        """Time of the session's clock."""

    def move_to_q(self, q_rad: Sequence[float]) -> None:
        """Go to joint angles and stop there."""

    def release(self) -> None:
        """Let the operator guide the arm: drives off, in a way that does not drop it."""

    def hold(self) -> None:
        """Hold the present position by the drives."""

    def average(self, duration_s: float) -> Sample:
        """Mean of encoders and currents over the next duration_s."""


class JogPort(ArmPort, Protocol):
    """An arm that an operator may also jog."""

    def creep_to_q(self, q_rad: Sequence[float]) -> None:
        """Go slowly to joint angles near by and stop there."""


class TipSeat(Protocol):
    """The hand that seats the tip: an operator who is asked to, or the mock hand."""

    def grip(self) -> None:
        """Return when the hand has the arm, so that the drives may let it go."""

    def seat(self, point_m: Vector) -> None:
        """Return when the tip sits in the cavity at point_m (base frame)."""

    def let_go(self) -> None:
        """The hand is off the arm."""


class Camera(Protocol):
    """Something that measures the tip in the base frame."""

    def measure(self, duration_s: float) -> tuple[Vector, Vector]:
        """Mean tip position [m] over duration_s, and its standard deviation per axis [m]."""


class Geometry(Protocol):
    """The arm's geometry as its file says; `calib.session.moves.geometry` has it of an arm.toml."""

    def tip(self, q_rad: Sequence[float]) -> Vector:
        """Tip [m] in the base frame."""

    def nearest(self, point: Vector, q_near: Sequence[float]) -> Sequence[float]:
        """Joint angles for a tip position, on the branch nearest to q_near; ArmError where there are none."""
