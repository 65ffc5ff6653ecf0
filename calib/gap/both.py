"""One finding of two: static poses and time series of the same arm must agree on the effects that both can detect.

The same play, spring or encoder error appears at both levels. An effect that is ambiguous at one level and named at the other is
resolved. An effect named at one level is dropped if the other could name it and does not, or names another effect of the same
joint: one of the recordings is wrong, and the data do not say which.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

from calib.gap.effects.catalogue import role_of
from calib.gap.finding import EffectName, GapFinding, MeasuredMaps, Nameable, NamedEffect, Unknown

# Standard deviations, or share of the value, that two estimates of one parameter may differ by.
AGREE_sd, AGREE_SHARE = 3.0, 0.2
POSES, SERIES = "poses", "time series"
# Silence of a level that could name an effect speaks against it only where that level would see it this many times over: what
# it calls nameable is an effect of usual size, and the other level's may be small.
SURELY = 4.0
AT_FLOOR = 1.3  # times the noise: a level with more left than that has not said all that it shows
GEOMETRY = ("link_geometry", "base_frame")


@dataclass(frozen=True, slots=True)
class LevelFinding:
    """One level's finding and what to call it."""

    name: str
    finding: GapFinding

    def names(self) -> tuple[EffectName, ...]:
        """What it names, the geometry apart."""
        return tuple(one.name for one in self.finding.effects if one.name.effect not in GEOMETRY)

    def is_unsure_of(self, name: EffectName) -> bool:
        """Whether it stands in an ambiguous set."""
        return any(name in names for names in self.finding.ambiguous)

    def would_see(self, name: EffectName) -> bool:
        """Whether it could name the effect, with a wide margin."""
        return any(
            one.name == name and one.detectability >= SURELY * one.needed_sd and not one.confusable_with
            for one in self.finding.nameable
        )

    @property
    def is_explained(self) -> bool:
        """Whether nothing is left at this level: only then its silence says something."""
        return self.finding.unknown is None and self.finding.unexplained <= AT_FLOOR

    def rival_of(self, name: EffectName) -> EffectName | None:
        """What it names in the same role on the same joint in place of `name`."""
        role = role_of(name.effect)
        return next(
            (
                other
                for other in self.names()
                if other != name and role and role_of(other.effect) == role and other.acts_on == name.acts_on
            ),
            None,
        )


def brought_together(
    static: GapFinding | None, dynamic: GapFinding | None
) -> tuple[GapFinding, tuple[str, ...]]:
    """One finding, and sentences about where the levels agree or contradict. One level alone is returned unchanged."""
    if static is None or dynamic is None:
        only = static or dynamic
        if only is None:
            raise ValueError("expected the finding of at least one level")
        return only, ()
    poses, series = LevelFinding(POSES, static), LevelFinding(SERIES, dynamic)
    denied = {**_denied(poses, series), **_denied(series, poses)}
    resolved = _resolved(poses, series) + _resolved(series, poses)
    kept = (
        _without(_named_later(static, series), denied),
        _without(_named_later(dynamic, poses), denied),
    )
    both = _merged(*kept, _sets(poses, series), tuple(denied), tuple(denied.values()))
    return both, (*denied.values(), *resolved, *disagreements(*kept))


def disagreements(static: GapFinding, dynamic: GapFinding) -> tuple[str, ...]:
    """A sentence for each effect that both name with parameters that differ by more than they may."""
    other = {effect.name: effect for effect in dynamic.effects}
    sentences = []
    for effect in static.effects:
        for name, (value, sd) in effect.parameters.items():
            if effect.name.effect in GEOMETRY or name not in _parameters(other.get(effect.name)):
                continue
            also, also_sd = other[effect.name].parameters[name]
            limit = max(AGREE_sd * math.hypot(_known(sd), _known(also_sd)), AGREE_SHARE * abs(value))
            if abs(_apart(name, value, also)) > limit:
                sentences.append(
                    f"{effect.name}: {name} is {value:.4g} from poses and {also:.4g} from time series. They contradict each"
                    " other; check how they were recorded."
                )
    return tuple(sentences)


def _denied(one: LevelFinding, other: LevelFinding) -> dict[EffectName, str]:
    """What `one` names and `other` contradicts, with the reason."""
    return {name: why for name in one.names() if (why := _contradiction(name, one, other)) is not None}


def _contradiction(name: EffectName, one: LevelFinding, other: LevelFinding) -> str | None:
    if name in other.names() or other.is_unsure_of(name):
        return None
    rival = other.rival_of(name)
    if rival is not None and not one.is_unsure_of(rival) and (other.would_see(name) or one.would_see(rival)):
        return (
            f"The {one.name} show {name}, the {other.name} show {rival} instead. They contradict each other; neither is"
            " named."
        )
    if rival is None and other.would_see(name) and other.is_explained:
        return f"The {one.name} show {name}. The {other.name} should show it and do not; it is not named."
    return None


def _resolved(one: LevelFinding, other: LevelFinding) -> tuple[str, ...]:
    """A sentence for every set of `one` of which `other` names a member."""
    return tuple(
        f"The {one.name} alone cannot distinguish {', '.join(map(str, names))}; the {other.name} name {found}."
        for names in one.finding.ambiguous
        for found in names
        if found in other.names()
    )


def _sets(poses: LevelFinding, series: LevelFinding) -> tuple[tuple[EffectName, ...], ...]:
    """Ambiguous sets that the other level does not resolve; two that share members become what they share."""
    open_sets = [
        [names for names in one.finding.ambiguous if not any(name in other.names() for name in names)]
        for one, other in ((poses, series), (series, poses))
    ]
    found: list[tuple[EffectName, ...]] = []
    for names in open_sets[0]:
        shared = [tuple(n for n in names if n in other) for other in open_sets[1]]
        narrower = [one for one in shared if len(one) > 1]
        found.append(narrower[0] if narrower else names)
    found += [names for names in open_sets[1] if not any(set(names) & set(other) for other in open_sets[0])]
    return tuple(dict.fromkeys(found))


def _named_later(finding: GapFinding, other: LevelFinding) -> GapFinding:
    """Without a gap afterwards where the other level names what this one left open: nobody has looked with that name added. It
    takes the place of the map that the set had.
    """
    later = [name for names in finding.ambiguous for name in names if name in other.names()]
    if not later:
        return finding
    maps, nothing = finding.maps, dict.fromkeys(finding.after_si, math.nan)
    if maps is not None:
        named = {name.acts_on for name in later}
        kept = tuple(one for one in maps.maps if one.joint not in named)
        maps = MeasuredMaps(kept, ()) if kept else None
    return dataclasses.replace(
        finding, gap_after=math.nan, gap_explained=math.nan, after_si=nothing, maps=maps
    )


def _without(finding: GapFinding, denied: dict[EffectName, str]) -> GapFinding:
    """The finding with names taken back: the gap after is the one before the first of them, whose model is kept."""
    effects, gap_after = [], finding.gap_before
    is_cut = False
    for effect in finding.effects:
        if effect.name in denied:
            is_cut = True
            continue
        effects.append(effect)
        if not is_cut:
            gap_after = effect.gap_after
    if not is_cut:
        return finding
    share = min(1.0, gap_after / finding.gap_before) if finding.gap_before > 0.0 else 1.0
    before_si = {channel: share * value for channel, value in finding.before_si.items()}
    return dataclasses.replace(
        finding, effects=tuple(effects), gap_after=gap_after, gap_explained=math.nan, after_si=before_si
    )


def _merged(
    static: GapFinding,
    dynamic: GapFinding,
    ambiguous: tuple[tuple[EffectName, ...], ...],
    denied: Sequence[EffectName],
    reasons: Sequence[str],
) -> GapFinding:
    """Floors and gaps of all channels, every name once. The gap of both is the root mean square of the two."""
    sentences = [s for s in (static.next_experiment, dynamic.next_experiment) if s]
    if denied:
        names = " and ".join(map(str, denied))
        sentences.insert(
            0, f"Record poses and motions again in one session to find which level is wrong about {names}."
        )
    return GapFinding(
        arm=static.arm,
        data=(*static.data, *dynamic.data),
        noise_floor={**dynamic.noise_floor, **static.noise_floor},
        gap_before=math.hypot(static.gap_before, dynamic.gap_before) / math.sqrt(2.0),
        gap_after=math.hypot(static.gap_after, dynamic.gap_after) / math.sqrt(2.0),
        gap_explained=math.hypot(static.gap_explained, dynamic.gap_explained) / math.sqrt(2.0),
        before_si={**dynamic.before_si, **static.before_si},
        after_si={**dynamic.after_si, **static.after_si},
        effects=_effects(static, dynamic),
        ambiguous=ambiguous,
        unknown=_unknown(static, dynamic, denied, reasons),
        nameable=_nameable(static, dynamic),
        next_experiment=" ".join(_ended(s) for s in sentences) or None,
        is_held_out=static.is_held_out and dynamic.is_held_out,
        remainder=(*static.remainder, *dynamic.remainder),
        open_questions=(*static.open_questions, *dynamic.open_questions),
        maps=static.maps,
    )


def _unknown(
    static: GapFinding, dynamic: GapFinding, denied: Sequence[EffectName], reasons: Sequence[str]
) -> Unknown | None:
    """What either leaves open, and what the two contradict each other about."""
    parts = [one for one in (static.unknown, dynamic.unknown) if one is not None]
    where = [one.where for one in parts] + [reason.rstrip(".") for reason in reasons]
    if not where:
        return None
    nearest = max(parts, key=lambda one: one.explained, default=None)
    if nearest is None:
        return Unknown("; ".join(dict.fromkeys(where)), denied[0], 0.0)
    return Unknown("; ".join(dict.fromkeys(where)), nearest.nearest, nearest.explained)


def _effects(static: GapFinding, dynamic: GapFinding) -> tuple[NamedEffect, ...]:
    """Those of the poses first; an effect of both with their parameters, and both in its evidence.

    The file's geometry is that of the poses, identified beside these parameters; the time series were looked at with it.
    """
    found: dict[EffectName, NamedEffect] = {}
    for effect in (*static.effects, *dynamic.effects):
        known = found.get(effect.name)
        if known is None:
            found[effect.name] = effect
        elif effect.name.effect not in GEOMETRY:
            evidence = {**effect.evidence, **known.evidence, **_both_values(known, effect)}
            found[effect.name] = dataclasses.replace(known, evidence=evidence)
    return tuple(found.values())


def _both_values(poses: NamedEffect, series: NamedEffect) -> dict[str, float]:
    return {
        f"{name} by {level}": effect.parameters[name][0]
        for level, effect in ((POSES, poses), (SERIES, series))
        for name in effect.parameters
        if name in poses.parameters and name in series.parameters
    }


def _nameable(static: GapFinding, dynamic: GapFinding) -> tuple[Nameable, ...]:
    """Every effect once, where it is seen better; told apart where either level tells it apart."""
    found: dict[EffectName, Nameable] = {}
    for one in (*static.nameable, *dynamic.nameable):
        known = found.get(one.name)
        if known is None or _rank(one) > _rank(known):
            found[one.name] = one
    return tuple(found.values())


def _rank(one: Nameable) -> tuple[bool, float]:
    return one.is_nameable, one.detectability / one.needed_sd


def _parameters(effect: NamedEffect | None) -> dict[str, tuple[float, float]]:
    return dict(effect.parameters) if effect is not None else {}


def _apart(parameter: str, value: float, also: float) -> float:
    """How far two values differ; phases go round."""
    return math.remainder(also - value, 2.0 * math.pi) if parameter == "phase_rad" else also - value


def _known(sd: float) -> float:
    return sd if math.isfinite(sd) else 0.0


def _ended(sentence: str) -> str:
    text = sentence[:1].upper() + sentence[1:]
    return text if text.endswith(".") else f"{text}."
