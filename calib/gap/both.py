"""One finding of two: static poses and time series of one arm, each looked at with what the other tells (`posterior.told`)."""

from __future__ import annotations

import dataclasses
import math

from calib.gap.finding import GEOMETRY, EffectName, GapFinding, MeasuredMaps, Nameable, NamedEffect
from calib.gap.posterior.told import Told

POSES, SERIES = "poses", "time series"
IN_KINEMATICS = (GEOMETRY, "base_frame")


def brought_together(static: GapFinding | None, dynamic: GapFinding | None) -> GapFinding:
    """Floors and gaps of all channels, every name once. The gap of both is the root mean square of the two, and what either
    leaves open is open. One level alone is returned unchanged.
    """
    if static is None or dynamic is None:
        if (only := static or dynamic) is None:
            raise ValueError("expected the finding of at least one level")
        return only
    static, dynamic = _as_looked_at(static, dynamic), _as_looked_at(dynamic, static)
    sentences = [
        one[:1].upper() + one[1:] for one in (static.next_experiment, dynamic.next_experiment) if one
    ]
    open_ = [one for one in (static.unknown, dynamic.unknown) if one is not None]
    nearest = max(open_, key=lambda one: one.explained, default=None)
    seen: dict[EffectName, Nameable] = {}  # every effect where it is seen better
    for one in (*static.nameable, *dynamic.nameable):
        if one.name not in seen or _rank(one) > _rank(seen[one.name]):
            seen[one.name] = one

    def rms(key: str) -> float:
        return math.hypot(getattr(static, key), getattr(dynamic, key)) / math.sqrt(2.0)

    return GapFinding(
        arm=static.arm,
        data=(*static.data, *dynamic.data),
        noise_floor={**dynamic.noise_floor, **static.noise_floor},
        gap_before=rms("gap_before"),
        gap_after=rms("gap_after"),
        gap_explained=rms("gap_explained"),
        before_si={**dynamic.before_si, **static.before_si},
        after_si={**dynamic.after_si, **static.after_si},
        effects=_effects(static, dynamic),
        ambiguous=_sets(static, dynamic),
        unknown=nearest
        and dataclasses.replace(nearest, where="; ".join(dict.fromkeys(one.where for one in open_))),
        nameable=tuple(seen.values()),
        next_experiment=" ".join(one if one.endswith(".") else f"{one}." for one in sentences) or None,
        is_held_out=static.is_held_out and dynamic.is_held_out,
        remainder=(*static.remainder, *dynamic.remainder),
        open_questions=(*static.open_questions, *dynamic.open_questions),
        maps=static.maps,
    )


def changed_between(found: GapFinding, poses: Told, series: Told) -> tuple[str, ...]:
    """A doubt for each name whose size the two recordings by no means share: was the arm changed between them?"""
    return tuple(
        f"{one.name}: poses show {poses.words(one.name)}, time series {series.words(one.name)}. No arm has both: was it changed"
        " between the recordings? The new arm.toml has what is likeliest for both"
        for one in found.effects
        if poses.differs_from(series, one.name)
    )


def _as_looked_at(found: GapFinding, other: GapFinding) -> GapFinding:
    """Without a gap afterwards where the other names one of a set that this one left open even so: nobody has looked with that
    name added. It takes the place of the map that the set had.
    """
    named = {one.name for one in other.effects}
    later = {name.acts_on for names in found.ambiguous for name in names if name in named}
    if not later:
        return found
    kept = tuple(one for one in (found.maps or MeasuredMaps()).maps if one.joint not in later)
    return dataclasses.replace(
        found,
        gap_after=math.nan,
        gap_explained=math.nan,
        after_si=dict.fromkeys(found.after_si, math.nan),
        maps=MeasuredMaps(kept, ()) if kept else None,
    )


def _sets(static: GapFinding, dynamic: GapFinding) -> tuple[tuple[EffectName, ...], ...]:
    """Ambiguous sets of which the other level names none; two that share members become what they share."""
    of_poses, of_series = (
        [names for names in one.ambiguous if not {*names} & {effect.name for effect in other.effects}]
        for one, other in ((static, dynamic), (dynamic, static))
    )
    found = []
    for names in of_poses:
        shared = (tuple(name for name in names if name in other) for other in of_series)
        found.append(next((some for some in shared if len(some) > 1), names))
    found += [names for names in of_series if not any({*names} & {*other} for other in of_poses)]
    return tuple(dict.fromkeys(found))


def _effects(static: GapFinding, dynamic: GapFinding) -> tuple[NamedEffect, ...]:
    """Those of the poses first; an effect of both with their parameters and what motion alone shows, and both in its evidence.

    The file's geometry is that of the poses, identified beside these parameters; the time series were looked at with it.
    """
    found = {effect.name: effect for effect in static.effects}
    for effect in dynamic.effects:
        known = found.setdefault(effect.name, effect)
        if known is not effect and effect.name.effect not in IN_KINEMATICS:
            values = {
                f"{name} by {level}": one.parameters[name][0]
                for level, one in ((POSES, known), (SERIES, effect))
                for name in one.parameters
                if name in known.parameters and name in effect.parameters
            }
            evidence = {**effect.evidence, **known.evidence, **values}
            parameters = {**effect.parameters, **known.parameters}  # damping shows in motion alone
            found[effect.name] = dataclasses.replace(known, parameters=parameters, evidence=evidence)
    return tuple(found.values())


def _rank(one: Nameable) -> tuple[bool, float]:
    return one.is_nameable, one.detectability / one.needed_sd
