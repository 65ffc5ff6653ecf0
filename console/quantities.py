"""Quantities with units, such as `5mm` or `2deg`, converted to SI.

Printed and drawn values have the same units everywhere: lengths in mm; poses, ranges and the model's angles (with
their deviations and standard deviations) in deg; angular errors, backlash and noise in mrad. SI is used in
files for programs, and where an operator copies a value to arm.toml or to a command that takes rad or m.
"""

import math
import re

from control.errors import ArmError

UNITS = {
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0},
}
MOST_NOISE_rad = 0.05


def quantity(text: str, unit: str, what: str) -> float:
    """Parse a number with a unit of the same kind as `unit` ("m" or "rad"), converted to it; ArmError if invalid.

    A number without a unit is refused: 8 may be meant in millimetres and read in metres.
    """
    found = re.fullmatch(r"\s*([-+0-9.eE]+)\s*([a-z]+)\s*", text)
    factor = UNITS[unit].get(found[2]) if found else None
    try:
        value = float(found[1]) * factor if found and factor is not None else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        comma = "; write a decimal point, not a comma" if "," in text else ""
        raise ArmError(
            f'{what}: expected a number with one of the units {", ".join(UNITS[unit])}, got "{text}"{comma}'
        )
    return value


def length_m(text: str | None, option: str) -> float | None:
    """The length that an option gives, None if it was not given; ArmError if it is not above 0."""
    if text is None:
        return None
    found_m = quantity(text, "m", option)
    if found_m <= 0.0:
        raise ArmError(f"{option}: expected a length above 0, got {text}")
    return found_m


def orientation_noise_rad(text: str | None) -> float | None:
    """The angle of --orientation-noise, None if it was not given; ArmError if invalid."""
    if text is None:
        return None
    value = quantity(text, "rad", "--orientation-noise")
    if not 0.0 < value <= MOST_NOISE_rad:
        raise ArmError(
            f"--orientation-noise: expected an angle above 0, up to {MOST_NOISE_rad} rad, got {text}"
        )
    return value


def unit_of(name: str) -> str:
    """Unit of a geometric parameter by its name: angles are theta, alpha and turns about an axis."""
    return "rad" if re.match(r"(theta|alpha)\d", name) or re.search(r"_r[xyz]$", name) else "m"
