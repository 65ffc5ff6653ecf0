"""The parameters that are identified: names, units, nominal values and how far each may go."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from calib.arrays import Array
from calib.errors import CalibrationError

DH_KINDS = ("d", "theta", "L", "alpha")
DH_UNITS = ("m", "rad", "m", "rad")


@dataclass(frozen=True, slots=True)
class Parameter:
    """One unknown: `name` as in theta2, `unit` m or rad, nominal value, largest deviation from it."""

    name: str
    unit: str
    nominal: float
    bound: float


@dataclass(frozen=True, slots=True)
class Bounds:
    """Largest deviation per parameter. The defaults are those of SpringerPlus 5:1771, eq. (4): 5 mm and 2
    degrees.

    `own` overrides single parameters by name, in their unit (m or rad).
    """

    length_m: float = 0.005
    angle_rad: float = math.radians(2.0)
    own: Mapping[str, float] = field(default_factory=dict)

    def of(self, name: str, unit: str) -> float:
        """The bound of one parameter; it must be positive and finite."""
        bound = self.own.get(name, self.length_m if unit == "m" else self.angle_rad)
        if not (math.isfinite(bound) and bound > 0):
            raise CalibrationError(
                f"bound of {name}: expected a positive number of {unit}, got {bound};"
                " to hold a parameter, fix it"
            )
        return bound


def dh_names(link_count: int) -> tuple[str, ...]:
    """d1, theta1, L1, alpha1, d2, ...: the order of dh.ravel()."""
    return tuple(f"{kind}{link}" for link in range(1, link_count + 1) for kind in DH_KINDS)


def dh_parameters(
    dh: Array, bounds: Bounds, fixed: Collection[str] = ()
) -> tuple[tuple[Parameter, ...], tuple[int, ...]]:
    """Free parameters of a (links, 4) DH table, and where in dh.ravel() each stands."""
    names = dh_names(len(dh))
    unknown = sorted((set(fixed) | set(bounds.own)) - set(names))
    if unknown:
        raise CalibrationError(f"no DH parameter is called {', '.join(unknown)}; they are {', '.join(names)}")
    places = tuple(k for k, name in enumerate(names) if name not in fixed)
    if not places:
        raise CalibrationError("every DH parameter is fixed: free at least one")
    flat = dh.ravel()
    return (
        tuple(
            Parameter(names[k], DH_UNITS[k % 4], float(flat[k]), bounds.of(names[k], DH_UNITS[k % 4]))
            for k in places
        ),
        places,
    )
