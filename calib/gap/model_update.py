"""The named effects added to the model: what arm.toml becomes."""

from __future__ import annotations

import dataclasses

from calib.arrays import Array
from calib.gap.finding import GapFinding
from calib.gap.words import GEOMETRY
from control.model.arm import Arm, Calibration, Effect


def updated_arm(arm: Arm, found: GapFinding, dh: Array | None, made: Calibration) -> Arm:
    """The arm with what was named in place of its own effects of the same name and joint, and with the geometry `dh`."""
    named = [
        Effect(one.name.effect, one.name.joint, {name: value for name, (value, _) in one.parameters.items()})
        for one in found.effects
        if one.name.effect != GEOMETRY
    ]
    replaced = {(effect.effect, effect.joint) for effect in named}
    kept = [effect for effect in arm.effects if (effect.effect, effect.joint) not in replaced]
    fitted = arm if dh is None else arm.with_dh(dh)
    return dataclasses.replace(fitted, effects=(*kept, *named), calibration=made)
