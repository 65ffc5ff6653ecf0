"""Jogging: one small step of the tip along an axis, or of a joint."""

from __future__ import annotations

import re
from collections.abc import Sequence

from calib.errors import SessionError
from calib.session.dialogue import Jog
from calib.session.moves import ArmPort, Geometry, Vector

LONGEST_m, LONGEST_rad = 0.05, 0.1  # a typing error must not cause a collision
WINDOW_s = 0.02
AXES = "xyz"


def jogged(jog: Jog, arm: ArmPort, geometry: Geometry) -> Sequence[float]:
    """Joint angles after the step. SessionError for an invalid step, ArmError if it is out of reach."""
    if jog.arm:
        raise SessionError(
            f"jog: this session has one arm: expected an axis and a step, got {jog.arm!r} first"
        )
    q_rad = arm.average(WINDOW_s).q_rad
    if jog.axis in AXES and jog.axis:
        _require_small(jog, LONGEST_m, "m")
        x, y, z = geometry.tip(q_rad)
        step = [jog.step if axis == jog.axis else 0.0 for axis in AXES]
        tip: Vector = (x + step[0], y + step[1], z + step[2])
        return geometry.nearest(tip, q_rad)
    joint = re.fullmatch(r"j([1-9]\d?)", jog.axis)
    if joint is None or int(joint[1]) > len(q_rad):
        raise SessionError(f"jog: expected x, y, z or j1 to j{len(q_rad)}, got {jog.axis!r}")
    _require_small(jog, LONGEST_rad, "rad")
    number = int(joint[1]) - 1
    return [q + jog.step if k == number else q for k, q in enumerate(q_rad)]


def _require_small(jog: Jog, longest: float, unit: str) -> None:
    if not abs(jog.step) <= longest:
        raise SessionError(f"jog {jog.axis}: a step is {longest:g} {unit} at most, got {jog.step:g} {unit}")
