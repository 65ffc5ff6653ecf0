"""The named effects added to the model: what arm.toml becomes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from calib.gap.finding import GEOMETRY, EffectName, GapFinding, Parameters
from control.model.arm import Arm, Effect
from control.model.effects import total


def updated_arm(arm: Arm, found: GapFinding) -> Arm:
    """The arm with what was named, which is a total, in place of what its file has.

    An effect whose total is none is taken out, and so are measured maps: they were measured beside other effects.
    """
    effects = [one for one in found.effects if one.name.effect != GEOMETRY]
    named = [effect_of(one.name, one.parameters) for one in effects if not one.is_nothing]
    gone = {(one.name.effect, one.name.joint) for one in effects if one.is_nothing}
    kept = tuple(one for one in arm.effects if (one.effect, one.joint) not in gone)
    return with_totals(dataclasses.replace(arm, effects=kept, maps=()), named)


def effect_of(name: EffectName, parameters: Mapping[str, tuple[float, float]]) -> Effect:
    """As the arm's file has it: values without their standard deviations."""
    return Effect(name.effect, name.joint, {key: value for key, (value, _) in parameters.items()})


def with_totals(arm: Arm, found: Sequence[Effect]) -> Arm:
    """The arm with these effects in place of its own of the same names."""
    known = {(effect.effect, effect.joint): effect for effect in arm.effects}
    for effect in found:
        before = known.get((effect.effect, effect.joint))
        parameters = effect.parameters if before is None else {**before.parameters, **effect.parameters}
        known[effect.effect, effect.joint] = Effect(effect.effect, effect.joint, parameters)
    return dataclasses.replace(arm, effects=tuple(known.values()))


def as_totals(arm: Arm, found: GapFinding) -> GapFinding:
    """A finding of changes beside what the arm's file has, as one of totals."""
    known = {EffectName(effect.effect, effect.joint): effect.parameters for effect in arm.effects}
    effects = [
        dataclasses.replace(one, parameters=_total(one.name.effect, known[one.name], one.parameters))
        if one.name in known
        else one
        for one in found.effects
    ]
    return dataclasses.replace(found, effects=tuple(effects))


def _total(effect: str, known: Mapping[str, float], found: Parameters) -> Parameters:
    """Both as one effect of the same kind, with the standard deviations of what was found."""
    values = total(effect, known, {name: value for name, (value, _) in found.items()})
    return {name: (value, found.get(name, (value, 0.0))[1]) for name, value in values.items()}
