"""Quantities as an operator writes them, `5mm` or `2deg`, in SI units for the packages.

What is printed, reported and drawn has the same units everywhere: lengths in mm; poses, ranges and the model's angles (with
their deviations and standard deviations beside them) in deg; angular errors, play and noise by themselves in mrad. SI stands in
files for programs, and where an operator copies a value into arm.toml or back into a command that takes rad or m.
"""

import math
import re

from control.errors import ArmError

UNITS = {
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0},
}


def quantity(text: str, unit: str, what: str) -> float:
    """A number with a unit of the same kind as `unit` ("m" or "rad"), in that unit; ArmError if it is none.

    Without a unit it is refused: 8 may be millimetres to who writes it and metres to who reads it.
    """
    found = re.fullmatch(r"\s*([-+0-9.eE]+)\s*([a-z]+)\s*", text)
    factor = UNITS[unit].get(found[2]) if found else None
    try:
        value = float(found[1]) * factor if found and factor is not None else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ArmError(
            f'{what}: expected a number with one of the units {", ".join(UNITS[unit])}, got "{text}"'
        )
    return value


def unit_of(name: str) -> str:
    """Unit of a geometric parameter by its name: angles are theta, alpha and turns about an axis."""
    return "rad" if re.match(r"(theta|alpha)\d", name) or re.search(r"_r[xyz]$", name) else "m"
