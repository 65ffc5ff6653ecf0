"""One finding of two: static poses and time series of the same arm."""

from __future__ import annotations

import dataclasses
import math

from calib.gap.finding import EffectName, GapFinding, Nameable, NamedEffect

AGREE_sd, AGREE_SHARE = (
    3.0,
    0.2,
)  # standard deviations, or share of the value, that two estimates of one parameter may differ by


def merged(static: GapFinding, dynamic: GapFinding) -> GapFinding:
    """Both findings as one: floors and gaps of all channels, every name once, with the better known parameters.

    The gap of both is the root mean square of the two.
    """
    return GapFinding(
        arm=static.arm,
        data=(*static.data, *dynamic.data),
        noise_floor={**dynamic.noise_floor, **static.noise_floor},
        gap_before=math.hypot(static.gap_before, dynamic.gap_before) / math.sqrt(2.0),
        gap_after=math.hypot(static.gap_after, dynamic.gap_after) / math.sqrt(2.0),
        before_si={**dynamic.before_si, **static.before_si},
        after_si={**dynamic.after_si, **static.after_si},
        effects=_effects(static, dynamic),
        ambiguous=(*static.ambiguous, *dynamic.ambiguous),
        unknown=static.unknown or dynamic.unknown,
        nameable=_nameable(static, dynamic),
        next_experiment=" ".join(s for s in (static.next_experiment, dynamic.next_experiment) if s) or None,
    )


def disagreements(static: GapFinding, dynamic: GapFinding) -> tuple[str, ...]:
    """A sentence for each effect that both name with parameters that differ by more than they may."""
    other = {effect.name: effect for effect in dynamic.effects}
    said = []
    for effect in static.effects:
        for name, (value, sd) in effect.parameters.items():
            if effect.name not in other or name not in other[effect.name].parameters:
                continue
            also, also_sd = other[effect.name].parameters[name]
            limit = max(AGREE_sd * math.hypot(_known(sd), _known(also_sd)), AGREE_SHARE * abs(value))
            if abs(value - also) > limit:
                said.append(
                    f"{effect.name}: poses say {name} = {value:.4g}, time series {also:.4g}; both cannot be right, look at how"
                    " they were recorded."
                )
    return tuple(said)


def _known(sd: float) -> float:
    return sd if math.isfinite(sd) else 0.0


def _effects(static: GapFinding, dynamic: GapFinding) -> tuple[NamedEffect, ...]:
    """Those of the poses first; an effect of both with the parameters that are known better."""
    found: dict[EffectName, NamedEffect] = {}
    for effect in (*static.effects, *dynamic.effects):
        known = found.get(effect.name)
        if known is None or _doubt(effect) < _doubt(known):
            found[effect.name] = effect
    return tuple(found.values())


def _doubt(effect: NamedEffect) -> float:
    """The largest standard deviation of its parameters, as a share of their values."""
    shares = [sd / abs(value) for value, sd in effect.parameters.values() if value and math.isfinite(sd)]
    return max(shares, default=math.inf)


def _nameable(static: GapFinding, dynamic: GapFinding) -> tuple[Nameable, ...]:
    """Every effect once, where it is seen better."""
    found: dict[EffectName, Nameable] = {}
    for one in (*static.nameable, *dynamic.nameable):
        known = found.get(one.name)
        if known is None or one.detectability > known.detectability:
            found[one.name] = dataclasses.replace(one)
    return tuple(found.values())
