"""control's kinematics in the form that an identification needs: DH table and tool as arguments."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
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
        self.made_dh, self.made_sd = made_geometry(arm)

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
MADE_BOUND_sd = 4.0  # at least, where the arm's file says how exactly a part is made: one normal part in 16,000 is further off
# Unknowns without a nominal value (pose of a board, length of a tool) are scaled by this many times the
# bounds above, so that what the data cannot distinguish from a DH parameter moves them instead of the DH parameter.
FREE_TIMES = 100.0


@dataclass(frozen=True, slots=True)
class Parameter:
    """One unknown: name such as theta2, unit ("m", "rad" or another), nominal value, largest deviation.

    An infinite `bound` means no bound. `typical` is the deviation of the solver's x = 1; 0 for the
    bound itself. `sd`: how exactly the part is made, known before any measurement, about the deviation `made`; infinite: unknown.
    """

    name: str
    unit: str
    nominal: float
    bound: float
    typical: float = 0.0
    sd: float = math.inf
    made: float = 0.0

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
    """Largest deviation per parameter. None: 5 mm and 2 degrees (SpringerPlus 5:1771, eq. (4)), or more by the arm's tolerances.

    `own` overrides single parameters by name, in their unit.
    """

    length_m: float | None = None
    angle_rad: float | None = None
    own: Mapping[str, float] = field(default_factory=dict)

    def of(self, name: str, unit: str, made_sd: float = math.inf) -> float:
        """The bound of a DH parameter that is made as exactly as `made_sd`; it must be positive and finite."""
        general, usual = (self.length_m, LENGTH_BOUND_m) if unit == "m" else (self.angle_rad, ANGLE_BOUND_rad)
        if general is None:
            general = max(usual, MADE_BOUND_sd * made_sd) if math.isfinite(made_sd) else usual
        return self._checked(name, unit, self.own.get(name, general))

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


def dh_parameters(model: ArmModel, bounds: Bounds) -> tuple[Parameter, ...]:
    """Every parameter of a DH table (links, 4), in the order of dh.ravel()."""
    dh, parameters = model.nominal_dh.ravel(), []
    for k, name in enumerate(dh_names(len(model.nominal_dh))):
        unit, sd = DH_UNITS[k % 4], float(model.made_sd.flat[k])
        made = float(model.made_dh.flat[k] - dh[k])
        parameters.append(Parameter(name, unit, float(dh[k]), bounds.of(name, unit, sd), sd=sd, made=made))
    return tuple(parameters)


def made_geometry(arm: Arm) -> tuple[Array, Array]:
    """The DH table (links, 4) that the arm's parts were made to, and how exactly: standard deviations, infinite where unknown.

    The theta of a joint's row also has the joint's zero in it.
    """
    made = arm.tolerances
    if made is None:
        return arm.dh, np.full((len(arm.links), 4), np.inf)
    dh, variance = np.array(made.about or arm.dh), np.full((len(arm.links), 4), np.nan)
    zeros = iter(made.of_joint(joint).encoder_zero_rad for joint in range(1, arm.joint_count + 1))
    for row, turns in enumerate(arm.joints):
        link, zero = made.of_link(row + 1), next(zeros) if turns else None
        for column, spreads in enumerate(((link.d_m,), (link.theta_rad, zero), (link.L_m,), (link.alpha_rad,))):
            if known := [spread for spread in spreads if spread is not None]:
                dh[row, column] += sum(spread.centre for spread in known)
                variance[row, column] = sum(spread.sd_about**2 for spread in known)
    return dh, np.where(np.isnan(variance), np.inf, np.sqrt(variance))


FREE_sd = 1e3  # of an unknown of which nothing is known beforehand, in its own scale


def prior_sd(parameters: Sequence[Parameter], bounded: float = FREE_sd, free: float = FREE_sd) -> Array:
    """Standard deviations (k,) of scaled unknowns before any measurement, where an arm's file says none: `bounded`, or `free`."""
    usual = (bounded if parameter.has_bound else free for parameter in parameters)
    return np.array([p.sd / p.scale if math.isfinite(p.sd) else other for p, other in zip(parameters, usual, strict=True)])


def require_known_names(wanted: Collection[str], names: Collection[str]) -> None:
    """CalibrationError that lists the valid names, if `wanted` holds another."""
    unknown = sorted(set(wanted) - set(names))
    if unknown:
        raise CalibrationError(f"no parameter {', '.join(unknown)}: expected one of {', '.join(names)}")
