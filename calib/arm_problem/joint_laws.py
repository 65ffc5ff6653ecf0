"""Static effects as laws that are linear in their unknowns; `joint_effects` applies them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from calib.arm_problem.link_bending import FLEXURE, Bending, bending
from calib.arrays import Array
from calib.errors import CalibrationError
from calib.points.points import Points
from control.dynamics.feedforward import own_payload_kg, with_link_inertia
from control.dynamics.static_pose import RestingPose, resting
from control.model.arm import Arm
from control.model.effect_laws import backlash_rad, compliance_rad
from control.model.effects import COUPLED_TO

COUPLING: Final = "belt_coupling"
DRIFT: Final = "thermal_drift"
SHARE_PARTS: Final = 8
FOLLOW_LOADS: Final = ("joint_compliance", FLEXURE)  # without a jump


class RestingPoints:
    """The points and, computed on demand from masses and drives, the state of their gears at joint angles joint_rad (m, n)."""

    def __init__(self, arm: Arm, points: Points, joint_rad: Array) -> None:
        self.points, self.joint_rad, self._arm = points, joint_rad, arm

    @cached_property
    def resting(self) -> RestingPose:
        """The state of the gears. MissingModel if the arm's file lacks masses."""
        seen = self.points
        payload_kg = np.nan_to_num(seen.payload_kg)
        return resting(self._arm, self.joint_rad, seen.direction, seen.current_A, payload_kg)

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

    def warmed(self, joint: int) -> Array:
        """The share (m,) of its final value that a joint's drift has reached since the recording began, 0 where no time is known.

        CalibrationError unless the arm's file says how fast: the drift is not linear in its time constant.
        """
        given = [e for e in self._arm.effects if (e.effect, e.joint) == (DRIFT, joint)]
        if not given:
            raise CalibrationError(
                f"{DRIFT} of joint {joint}: arm {self._arm.name} has no [[effect]] that says its time_constant_s; `armwright gap`"
                " finds it"
            )
        return np.nan_to_num(1.0 - np.exp(-self.points.elapsed_s / given[0].parameters["time_constant_s"]))

    def bent(self, link: int) -> Bending:
        """What a link's bending does to the tip and to the last link, per 1 / EI."""
        arm = with_link_inertia(self._arm)
        loads_kg = np.nan_to_num(self.points.payload_kg) + own_payload_kg(arm)
        return bending(arm, arm.dh, self.joint_rad, loads_kg, link)

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
class LawTerm:
    """One linear parameter: name before and after the number of joint or link, unit, bound, slope (m,) of the joint's angle.

    `is_side`: not part of the effect, and omitted if it has no influence. `is_of_tip`: no joint moves, but a link bends.
    """

    head: str
    tail: str
    unit: str
    bound: float
    slope: Slope
    is_side: bool = False
    is_of_tip: bool = False

    def name(self, joint: int | None) -> str:
        """backlash2, eccentricity2_sin, belt_coupling."""
        return f"{self.head}{joint or ''}{self.tail}"


def _unclear(part: int) -> LawTerm:
    """Mean position in the backlash of the unclear poses of one part of SHARE_PARTS."""

    def slope(at: RestingPoints, joint: int) -> Array:
        return np.asarray(backlash_rad(at.unclear_side(joint, part), 1.0))

    return LawTerm("backlash", f"_unclear{part + 1}", "rad", 0.05, slope, True)


def _harmonic(part: Callable[[Array], Array]) -> Slope:
    """Sine or cosine of the joint's angle."""
    return lambda at, joint: part(at.q_rad(joint))


# Of each effect its linear parameters: first those of its record (control.model.effects), then side parameters.
LAWS: Final[Mapping[str, tuple[LawTerm, ...]]] = {
    "encoder_scale": (LawTerm("encoder_scale", "", "1", 0.05, lambda at, j: at.q_rad(j)),),
    "encoder_eccentricity": (
        LawTerm("eccentricity", "_sin", "rad", 0.05, _harmonic(np.sin)),
        LawTerm("eccentricity", "_cos", "rad", 0.05, _harmonic(np.cos)),
    ),
    "backlash": (
        LawTerm("backlash", "", "rad", 0.05, lambda at, j: backlash_rad(at.flank(j), 1.0)),
        *(_unclear(part) for part in range(SHARE_PARTS)),
        LawTerm("backlash", "_led", "rad", 0.05, lambda at, j: backlash_rad(at.led_side(j), 1.0), True),
    ),
    "joint_compliance": (
        LawTerm("compliance", "", "rad/Nm", 0.01, lambda at, j: compliance_rad(at.gravity_Nm(j), 1.0)),
        LawTerm(
            "compliance", "_held", "rad/Nm", 0.01, lambda at, j: compliance_rad(at.held_Nm(j), 1.0), True
        ),
    ),
    COUPLING: (LawTerm(COUPLING, "", "1", 0.1, lambda at, j: at.q_rad(COUPLED_TO)),),
    DRIFT: (LawTerm(DRIFT, "", "rad", 0.05, lambda at, j: at.warmed(j)),),
    FLEXURE: (
        LawTerm("flexure", "", "1/(N m2)", 0.1, lambda at, k: np.zeros(len(at.points)), is_of_tip=True),
    ),
}
