"""The named effects added to the model: what arm.toml becomes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from calib.gap.finding import GEOMETRY, LINK_KEYS, EffectName, GapFinding, Parameters
from control.model.arm import Arm, Effect
from control.model.effects import EFFECTS, total


def updated_arm(arm: Arm, found: GapFinding) -> Arm:
    """The arm with what was named, which is a total, and with the maps that were found, in place of what its file has.

    An effect whose total is none is taken out, and so are maps that were measured beside other effects.
    """
    effects = [one for one in found.effects if one.name.effect != GEOMETRY]
    named = [effect_of(one.name, one.parameters) for one in effects if not one.is_nothing]
    gone = {(one.name.effect, one.name.joint) for one in effects if one.is_nothing}
    kept = tuple(one for one in arm.effects if (one.effect, one.joint) not in gone)
    maps = () if found.maps is None else found.maps.maps
    return with_totals(dataclasses.replace(arm, effects=kept, maps=maps), named)


def with_geometry(arm: Arm, found: GapFinding) -> Arm:
    """The arm with the deviations of its links that time series showed."""
    dh = np.array(arm.dh)
    for one in found.effects:
        for name, (value, _) in one.parameters.items() if one.name.effect == GEOMETRY else ():
            link, kind = name.removeprefix("link").split("_", 1)
            dh[int(link) - 1, LINK_KEYS.index(kind)] += value
    return arm.with_dh(dh)


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
    """A finding of changes beside what the arm's file has, as one of totals; a total that no part can have is none."""
    known = {EffectName(effect.effect, effect.joint): effect.parameters for effect in arm.effects}
    effects = [
        dataclasses.replace(one, parameters=as_total(one.name.effect, known[one.name], one.parameters))
        if one.name in known
        else one
        for one in found.effects
    ]
    effects = [
        one
        if is_possible(one.name.effect, one.parameters)
        else dataclasses.replace(one, parameters={}, is_nothing=True)
        for one in effects
    ]
    return dataclasses.replace(found, effects=tuple(effects))


def is_possible(effect: str, parameters: Parameters) -> bool:
    """Whether a file may have them: no friction is below nought."""
    kind = EFFECTS[effect]
    values = {name: value for name, (value, _) in parameters.items()}
    return not any(values.get(name, 1.0) <= 0.0 for name in kind.positive) and not any(
        values.get(name, 0.0) < 0.0 for name in kind.not_negative
    )


def as_total(effect: str, known: Mapping[str, float], found: Parameters) -> Parameters:
    """Both as one effect of the same kind, with the standard deviations of what was found."""
    values = total(effect, known, {name: value for name, (value, _) in found.items()})
    return {name: (value, found.get(name, (value, 0.0))[1]) for name, value in values.items()}
