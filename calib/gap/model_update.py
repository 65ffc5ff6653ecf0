"""The named effects added to the model: what arm.toml becomes."""

from __future__ import annotations

import cmath
import dataclasses
from collections.abc import Mapping, Sequence

from calib.arrays import Array
from calib.gap.finding import GEOMETRY, EffectName, GapFinding
from control.model.arm import Arm, Calibration, Effect

Parameters = Mapping[str, float]
# What is found comes on top of what the file knows; where two add up to one of the same kind, their sum is written. Others are
# replaced: no single law is the sum of two of different speed, order or time.
SUMMED = (
    "encoder_scale", "backlash", "belt_coupling", "payload", "coulomb_friction", "viscous_friction", "load_friction",
    "asymmetric_friction", "command_delay", "supply_sag", "link_inertia",
)  # fmt: skip


def updated_arm(arm: Arm, found: GapFinding, dh: Array | None, made: Calibration) -> Arm:
    """The arm with what was named added to its own effects, and with the geometry `dh`."""
    named = [effect_of(one.name, one.parameters) for one in found.effects if one.name.effect != GEOMETRY]
    fitted = arm if dh is None else arm.with_dh(dh)
    return dataclasses.replace(with_named(fitted, named), calibration=made)


def effect_of(name: EffectName, parameters: Mapping[str, tuple[float, float]]) -> Effect:
    """As the arm's file has it: values without their standard deviations."""
    return Effect(name.effect, name.joint, {key: value for key, (value, _) in parameters.items()})


def with_named(arm: Arm, named: Sequence[Effect]) -> Arm:
    """The arm with these effects on top of its own."""
    known = {(effect.effect, effect.joint): effect for effect in arm.effects}
    added = [_on_top(known.get((effect.effect, effect.joint)), effect) for effect in named]
    replaced = {(effect.effect, effect.joint) for effect in named}
    kept = [effect for effect in arm.effects if (effect.effect, effect.joint) not in replaced]
    return dataclasses.replace(arm, effects=(*kept, *added))


def _on_top(known: Effect | None, found: Effect) -> Effect:
    if known is None:
        return found
    return Effect(found.effect, found.joint, _sum(found.effect, known.parameters, found.parameters))


def _sum(effect: str, known: Parameters, found: Parameters) -> Parameters:
    """Both as one of the same kind; what was found alone where there is no such."""
    if effect in SUMMED and known.keys() == found.keys():
        return {name: value + known[name] for name, value in found.items()}
    if effect == "joint_compliance":  # two springs behind each other
        softness = 1.0 / known["stiffness_Nm_rad"] + 1.0 / found["stiffness_Nm_rad"]
        return {**known, **found, "stiffness_Nm_rad": 1.0 / softness}
    if effect == "torque_constant":
        return {"scale": known["scale"] * found["scale"]}
    amplitude = "amplitude_rad" if effect == "encoder_eccentricity" else "amplitude_Nm"
    is_wave = effect in ("encoder_eccentricity", "cogging")
    if is_wave and known.get("order") == found.get("order"):
        both = cmath.rect(known[amplitude], known["phase_rad"]) + cmath.rect(
            found[amplitude], found["phase_rad"]
        )
        return {**found, amplitude: abs(both), "phase_rad": cmath.phase(both)}
    return found
