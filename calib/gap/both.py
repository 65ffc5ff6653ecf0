"""One finding of two: static poses and time series of the same arm must agree on the effects that both can detect.

The same play, spring or encoder error appears at both levels. An effect that is ambiguous at one level and named at the other is
resolved. An effect named at one level is dropped if the other could name it and does not, or names another effect of the same
joint: one of the recordings is wrong, and the data do not say which.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

from calib.gap.effects.catalogue import role_of
from calib.gap.finding import EffectName, GapFinding, MeasuredMaps, Nameable, NamedEffect, Unknown
from calib.gap.posterior.constants import AGREE, INFLATED, SURELY, SURE_sd

POSES, SERIES = "poses", "time series"
GEOMETRY = ("link_geometry", "base_frame")


@dataclass(frozen=True, slots=True)
class LevelFinding:
    """One level's finding and what to call it."""

    name: str
    finding: GapFinding

    @property
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

    def against(self, name: EffectName, other: LevelFinding) -> str:
        """Why the name of another level cannot stand beside this one, in a sentence; empty where it can."""
        if name in self.names or self.is_unsure_of(name):
            return ""
        role = role_of(name.effect)
        rivals = (
            one for one in self.names if role and role_of(one.effect) == role and one.acts_on == name.acts_on
        )
        rival = next(rivals, None)
        if rival is not None:
            if other.is_unsure_of(rival) or not (self.would_see(name) or other.would_see(rival)):
                return ""
            return (
                f"The {other.name} show {name}, the {self.name} show {rival} instead. They contradict each other; neither is"
                " named."
            )
        # only where nothing is left of this level its silence says something
        is_explained = self.finding.unknown is None and self.finding.unexplained <= INFLATED
        if self.would_see(name) and is_explained:
            return (
                f"The {other.name} show {name}. The {self.name} should show it and do not; it is not named."
            )
        return ""

    def with_names_of(self, other: LevelFinding, denied: Mapping[EffectName, str]) -> GapFinding:
        """The finding without names taken back: the gap after is the one before the first of them, whose model is kept.

        Without a gap afterwards where the other level names what this one left open: nobody has looked with that name added. It
        takes the place of the map that the set had.
        """
        found = self.finding
        later = {name.acts_on for names in found.ambiguous for name in names if name in other.names}
        if later:
            kept = tuple(one for one in (found.maps or MeasuredMaps()).maps if one.joint not in later)
            found = dataclasses.replace(
                found,
                gap_after=math.nan,
                gap_explained=math.nan,
                after_si=dict.fromkeys(found.after_si, math.nan),
                maps=MeasuredMaps(kept, ()) if kept else None,
            )
        cut = next((k for k, one in enumerate(found.effects) if one.name in denied), None)
        if cut is None:
            return found
        gap_after = found.effects[cut - 1].gap_after if cut else found.gap_before
        share = min(1.0, gap_after / found.gap_before) if found.gap_before > 0.0 else 1.0
        return dataclasses.replace(
            found,
            effects=tuple(one for one in found.effects if one.name not in denied),
            gap_after=gap_after,
            gap_explained=math.nan,
            after_si={channel: share * value for channel, value in found.before_si.items()},
        )


def brought_together(
    static: GapFinding | None, dynamic: GapFinding | None
) -> tuple[GapFinding, tuple[str, ...]]:
    """One finding, and sentences about where the levels agree or contradict. One level alone is returned unchanged."""
    if static is None or dynamic is None:
        if (only := static or dynamic) is None:
            raise ValueError("expected the finding of at least one level")
        return only, ()
    poses, series = LevelFinding(POSES, static), LevelFinding(SERIES, dynamic)
    pairs = ((poses, series), (series, poses))
    denied = {name: why for one, other in pairs for name in one.names if (why := other.against(name, one))}
    resolved = tuple(
        f"The {one.name} alone cannot distinguish {', '.join(map(str, names))}; the {other.name} name {found}."
        for one, other in pairs
        for names in one.finding.ambiguous
        for found in names
        if found in other.names
    )
    kept = tuple(one.with_names_of(other, denied) for one, other in pairs)
    both = _merged(kept[0], kept[1], _sets(poses, series), denied)
    return both, (*denied.values(), *resolved, *disagreements(kept[0], kept[1]))


def disagreements(static: GapFinding, dynamic: GapFinding) -> tuple[str, ...]:
    """A sentence for each effect that both name with parameters that differ by more than they may."""
    other = {effect.name: effect.parameters for effect in dynamic.effects}
    sentences = []
    for effect in static.effects:
        for name, (value, sd) in effect.parameters.items():
            if effect.name.effect in GEOMETRY or name not in other.get(effect.name, {}):
                continue
            also, also_sd = other[effect.name][name]
            apart = math.remainder(also - value, math.tau) if name == "phase_rad" else also - value
            known = [one for one in (sd, also_sd) if math.isfinite(one)]
            if abs(apart) > max(SURE_sd * math.hypot(*known), AGREE * abs(value)):
                sentences.append(
                    f"{effect.name}: {name} is {value:.4g} from poses and {also:.4g} from time series. They contradict each"
                    " other; check how they were recorded."
                )
    return tuple(sentences)


def _sets(poses: LevelFinding, series: LevelFinding) -> tuple[tuple[EffectName, ...], ...]:
    """Ambiguous sets that the other level does not resolve; two that share members become what they share."""
    of_poses, of_series = (
        [names for names in one.finding.ambiguous if not set(names) & set(other.names)]
        for one, other in ((poses, series), (series, poses))
    )
    found = []
    for names in of_poses:
        shared = (tuple(name for name in names if name in other) for other in of_series)
        found.append(next((some for some in shared if len(some) > 1), names))
    found += [names for names in of_series if not any(set(names) & set(other) for other in of_poses)]
    return tuple(dict.fromkeys(found))


def _merged(
    static: GapFinding,
    dynamic: GapFinding,
    ambiguous: tuple[tuple[EffectName, ...], ...],
    denied: Mapping[EffectName, str],
) -> GapFinding:
    """Floors and gaps of all channels, every name once. The gap of both is the root mean square of the two.

    What either leaves open is unknown, and what the two contradict each other about.
    """
    sentences = [
        one[:1].upper() + one[1:] for one in (static.next_experiment, dynamic.next_experiment) if one
    ]
    if denied:
        names = " and ".join(map(str, denied))
        again = f"Record poses and motions again in one session to find which level is wrong about {names}."
        sentences.insert(0, again)
    open_ = [one for one in (static.unknown, dynamic.unknown) if one is not None]
    where = dict.fromkeys([one.where for one in open_] + [why.rstrip(".") for why in denied.values()])
    nearest = max(open_, key=lambda one: one.explained, default=Unknown("", next(iter(denied), None), 0.0))
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
        ambiguous=ambiguous,
        unknown=Unknown("; ".join(where), nearest.nearest, nearest.explained) if where else None,
        nameable=tuple(seen.values()),
        next_experiment=" ".join(one if one.endswith(".") else f"{one}." for one in sentences) or None,
        is_held_out=static.is_held_out and dynamic.is_held_out,
        remainder=(*static.remainder, *dynamic.remainder),
        open_questions=(*static.open_questions, *dynamic.open_questions),
        maps=static.maps,
    )


def _effects(static: GapFinding, dynamic: GapFinding) -> tuple[NamedEffect, ...]:
    """Those of the poses first; an effect of both with their parameters, and both in its evidence.

    The file's geometry is that of the poses, identified beside these parameters; the time series were looked at with it.
    """
    found = {effect.name: effect for effect in static.effects}
    for effect in dynamic.effects:
        known = found.setdefault(effect.name, effect)
        if known is not effect and effect.name.effect not in GEOMETRY:
            values = {
                f"{name} by {level}": one.parameters[name][0]
                for level, one in ((POSES, known), (SERIES, effect))
                for name in one.parameters
                if name in known.parameters and name in effect.parameters
            }
            evidence = {**effect.evidence, **known.evidence, **values}
            found[effect.name] = dataclasses.replace(known, evidence=evidence)
    return tuple(found.values())


def _rank(one: Nameable) -> tuple[bool, float]:
    return one.is_nameable, one.detectability / one.needed_sd
