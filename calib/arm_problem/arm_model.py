"""control's kinematics in the form that an identification needs: DH table and tool as arguments."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np

from calib.arrays import Array
from calib.errors import CalibrationError
from control.kinematics import chain
from control.kinematics.chain import TipSlopes, tip_slopes
from control.model.arm import Arm


class ArmModel:
    """The structure of an arm: revolute links, DH convention, nominal DH table and tool."""

    def __init__(self, arm: Arm) -> None:
        """Only the geometry of `arm` is used."""
        self.joints, self._convention = arm.joints, arm.dh_convention
        self.nominal_dh, self.nominal_tool_m = arm.dh, np.array(arm.tool.position_m)

    def tips(self, dh: Array, q: Array, tool_m: Array | None = None) -> Array:
        """Tip positions (m, 3) [m] in the base frame, of DH table (links, 4), poses (m, n), tool (3,)."""
        tool = self.nominal_tool_m if tool_m is None else tool_m
        steps = chain.steps(dh.tolist(), self.joints, self._convention)
        tip = chain.tip(steps, list(q.T), tool.tolist())
        return np.column_stack([np.broadcast_to(np.asarray(part, dtype=float), len(q)) for part in tip])

    def slopes(self, dh: Array, q: Array, tool_m: Array | None = None) -> TipSlopes:
        """Tips and their derivatives by dh.ravel() and by the tool."""
        tool = self.nominal_tool_m if tool_m is None else tool_m
        return tip_slopes(dh, q, self.joints, self._convention, tool.tolist())

    @property
    def is_modified(self) -> bool:
        """Whether L and alpha come before d and theta."""
        return self._convention == "modified"

    @property
    def theta_places(self) -> tuple[int, ...]:
        """Index in dh.ravel() of each joint's theta, whose column is the derivative by the joint angle."""
        return tuple(4 * link + 1 for link, turns in enumerate(self.joints) if turns)


# The identified parameters: names, units, nominal values and bounds.


DH_KINDS = ("d", "theta", "L", "alpha")
DH_UNITS = ("m", "rad", "m", "rad")
LENGTH_BOUND_m = 0.005  # SpringerPlus 5:1771, eq. (4)
ANGLE_BOUND_rad = math.radians(2.0)
# Unknowns without a nominal value (pose of a board, length of a tool) are scaled by this many times the
# bounds above, so that what the data cannot distinguish from a DH parameter moves them instead of the DH parameter.
FREE_TIMES = 100.0


@dataclass(frozen=True, slots=True)
class Parameter:
    """One unknown: name such as theta2, unit ("m", "rad" or another), nominal value, largest deviation.

    An infinite `bound` means no bound. `typical` is the deviation of the solver's x = 1; 0 for the
    bound itself.
    """

    name: str
    unit: str
    nominal: float
    bound: float
    typical: float = 0.0

    @property
    def scale(self) -> float:
        """The deviation at x = 1, in the parameter's unit."""
        if self.typical > 0.0:
            return self.typical
        if math.isfinite(self.bound):
            return self.bound
        return FREE_TIMES * (LENGTH_BOUND_m if self.unit == "m" else ANGLE_BOUND_rad)

    @property
    def limit(self) -> float:
        """The largest |x|."""
        return self.bound / self.scale

    @property
    def has_bound(self) -> bool:
        """Whether the deviation from nominal is bounded."""
        return math.isfinite(self.bound)


@dataclass(frozen=True, slots=True)
class Bounds:
    """Largest deviation per parameter. Defaults of SpringerPlus 5:1771, eq. (4): 5 mm and 2 degrees.

    `own` overrides single parameters by name, in their unit.
    """

    length_m: float = LENGTH_BOUND_m
    angle_rad: float = ANGLE_BOUND_rad
    own: Mapping[str, float] = field(default_factory=dict)

    def of(self, name: str, unit: str) -> float:
        """The bound of a DH parameter; it must be positive and finite."""
        return self._checked(name, unit, self.own.get(name, self.length_m if unit == "m" else self.angle_rad))

    def of_free(self, name: str, unit: str) -> float:
        """The bound of an unknown that has none unless `own` gives it one."""
        return self._checked(name, unit, self.own[name]) if name in self.own else math.inf

    @staticmethod
    def _checked(name: str, unit: str, bound: float) -> float:
        if not (math.isfinite(bound) and bound > 0):
            raise CalibrationError(
                f"bound of {name}: expected a positive number of {unit}, got {bound}; to exclude a parameter, fix it"
            )
        return bound


def dh_names(link_count: int) -> tuple[str, ...]:
    """d1, theta1, L1, alpha1, d2, ...: the order of dh.ravel()."""
    return tuple(f"{kind}{link}" for link in range(1, link_count + 1) for kind in DH_KINDS)


def dh_parameters(dh: Array, bounds: Bounds) -> tuple[Parameter, ...]:
    """Every parameter of a (links, 4) DH table, in the order of dh.ravel()."""
    return tuple(
        Parameter(name, DH_UNITS[k % 4], float(value), bounds.of(name, DH_UNITS[k % 4]))
        for k, (name, value) in enumerate(zip(dh_names(len(dh)), dh.ravel(), strict=True))
    )


def require_known_names(wanted: Collection[str], names: Collection[str]) -> None:
    """CalibrationError that lists the valid names, if `wanted` holds another."""
    unknown = sorted(set(wanted) - set(names))
    if unknown:
        raise CalibrationError(f"no parameter {', '.join(unknown)}: expected one of {', '.join(names)}")
