"""Static effects between encoder and joint as laws that are linear in their unknowns; `joint_effects` applies them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from calib.arrays import Array
from calib.points.points import Points
from control.dynamics.effect_laws import (
    backlash_rad,
    belt_coupling_rad,
    compliance_rad,
    encoder_eccentricity_rad,
    encoder_scale_rad,
)
from control.dynamics.static_pose import RestingPose, resting
from control.model.arm import Arm
from control.model.effects import COUPLED_TO

COUPLING: Final = "belt_coupling"
SHARE_PARTS: Final = 8


class RestingPoints:
    """The points and, computed on demand from masses and drives, the state of their gears."""

    def __init__(self, arm: Arm, points: Points) -> None:
        self.points, self._arm = points, arm

    @cached_property
    def resting(self) -> RestingPose:
        """The state of the gears. MissingModel if the arm's file lacks masses."""
        seen = self.points
        payload_kg = np.nan_to_num(seen.payload_kg)
        return resting(self._arm, seen.q_rad, seen.direction, seen.current_A, payload_kg)

    def q_rad(self, joint: int) -> Array:
        """Encoder angles (m,) of a joint, 1-based."""
        return np.asarray(self.points.q_rad[:, joint - 1])

    def flank(self, joint: int) -> Array:
        """Flanks (m,) of a joint's gear, 0 where unclear."""
        return np.asarray(self.resting.flank[:, joint - 1])

    def gravity_Nm(self, joint: int) -> Array:
        """Gravity torque (m,) of a joint."""
        return np.asarray(self.resting.gravity_Nm[:, joint - 1])

    def held_Nm(self, joint: int) -> Array:
        """Friction (m,) that a joint's motor holds."""
        return np.asarray(self.resting.held_Nm[:, joint - 1])

    def led_side(self, joint: int) -> Array:
        """The flank (m,) near which the gear lies after hand guiding, if the motor does not push it, else 0."""
        return self._leaning(joint, self.resting.is_led[:, joint - 1])

    def unclear_side(self, joint: int, part: int) -> Array:
        """The flank (m,) by friction alone if a driven joint's is unclear, else 0.

        `part` of SHARE_PARTS: friction decides if its link-side share exceeds -gravity / held torque; poses with
        that ratio in this part of 0 .. 1 change flank together.
        """
        gravity, held = self.gravity_Nm(joint), self.held_Nm(joint)
        ratio = np.divide(-gravity, held, out=np.zeros(held.shape), where=held != 0.0)
        which = np.clip(np.floor(SHARE_PARTS * ratio), 0, SHARE_PARTS - 1)
        return self._leaning(joint, ~self.resting.is_led[:, joint - 1] & (which == part))

    def _leaning(self, joint: int, counts: npt.NDArray[np.bool_]) -> Array:
        of = joint - 1
        return np.where(counts & (self.resting.flank[:, of] == 0.0), self.resting.leaning[:, of], 0.0)


Slope = Callable[[RestingPoints, int], Array]


@dataclass(frozen=True, slots=True)
class Term:
    """One linear parameter: name before and after the joint's number, unit, bound, slope (m,).

    `is_side`: not part of the effect, and omitted if it has no influence.
    """

    head: str
    tail: str
    unit: str
    bound: float
    slope: Slope
    is_side: bool = False

    def name(self, joint: int | None) -> str:
        """backlash2, eccentricity2_sin, belt_coupling."""
        return f"{self.head}{joint or ''}{self.tail}"


@dataclass(frozen=True, slots=True)
class Law:
    """An effect: its linear parameters, and the conversions from and to those of docs/formats.md (None: no such effect)."""

    terms: tuple[Term, ...]
    linear: Callable[[Mapping[str, float]], tuple[float, ...]]
    parameters: Callable[[Sequence[float]], dict[str, float] | None]


def _positive(key: str, invert: bool = False) -> Callable[[Sequence[float]], dict[str, float] | None]:
    """A parameter that is above 0, or its inverse."""

    def made(values: Sequence[float]) -> dict[str, float] | None:
        return {key: 1.0 / values[0] if invert else values[0]} if values[0] > 0.0 else None

    return made


def _eccentricity(values: Sequence[float]) -> dict[str, float] | None:
    sine, cosine = values
    if sine == cosine == 0.0:
        return None
    return {"amplitude_rad": math.hypot(sine, cosine), "phase_rad": math.atan2(cosine, sine)}


def _unclear(part: int) -> Term:
    """Mean position in the backlash of the unclear poses of one part of SHARE_PARTS."""

    def slope(at: RestingPoints, joint: int) -> Array:
        return np.asarray(backlash_rad(at.unclear_side(joint, part), 1.0))

    return Term("backlash", f"_unclear{part + 1}", "rad", 0.05, slope, True)


LAWS: Final[Mapping[str, Law]] = {
    "encoder_scale": Law(
        (Term("encoder_scale", "", "1", 0.05, lambda at, j: encoder_scale_rad(at.q_rad(j), 1.0)),),
        lambda p: (p["scale"],),
        lambda values: {"scale": values[0]},
    ),
    "encoder_eccentricity": Law(
        (
            Term(
                "eccentricity",
                "_sin",
                "rad",
                0.05,
                lambda at, j: encoder_eccentricity_rad(at.q_rad(j), 1.0, 0.0),
            ),
            Term(
                "eccentricity",
                "_cos",
                "rad",
                0.05,
                lambda at, j: encoder_eccentricity_rad(at.q_rad(j), 1.0, 0.5 * math.pi),
            ),
        ),
        lambda p: (
            p["amplitude_rad"] * math.cos(p["phase_rad"]),
            p["amplitude_rad"] * math.sin(p["phase_rad"]),
        ),
        _eccentricity,
    ),
    "backlash": Law(
        (
            Term("backlash", "", "rad", 0.05, lambda at, j: backlash_rad(at.flank(j), 1.0)),
            *(_unclear(part) for part in range(SHARE_PARTS)),
            Term("backlash", "_led", "rad", 0.05, lambda at, j: backlash_rad(at.led_side(j), 1.0), True),
        ),
        lambda p: (p["width_rad"],),
        _positive("width_rad"),
    ),
    "joint_compliance": Law(
        (
            Term("compliance", "", "rad/Nm", 0.01, lambda at, j: compliance_rad(at.gravity_Nm(j), 1.0)),
            Term(
                "compliance",
                "_held",
                "rad/Nm",
                0.01,
                lambda at, j: compliance_rad(at.held_Nm(j), 1.0),
                is_side=True,
            ),
        ),
        lambda p: (1.0 / p["stiffness_Nm_rad"],),
        _positive("stiffness_Nm_rad", invert=True),
    ),
    COUPLING: Law(
        (Term(COUPLING, "", "1", 0.1, lambda at, j: belt_coupling_rad(at.q_rad(COUPLED_TO), 1.0)),),
        lambda p: (p["ratio"],),
        lambda values: {"ratio": values[0]},
    ),
}
