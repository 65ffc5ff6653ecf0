"""What the gap workflow found, in sentences: the answer first."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence

from calib.gap.finding import GEOMETRY, EffectName, GapFinding, NamedEffect, Unknown
from calib.gap.posterior.constants import AT_FLOOR, NEAR, UNTOLD

LISTED_MOST = 6  # of names in a sentence


_UNITS = {"m": ("mm", 1e3), "A": ("mA", 1e3), "V": ("mV", 1e3), "rad": ("mrad", 1e3), "Nm": ("N m", 1.0)}


def unit_of(channel: str) -> tuple[str, float]:
    """The unit in which a reader sees a channel, and its factor: `tip_m` in mm."""
    unit = channel.rpartition("_")[2]
    return _UNITS.get(unit, (unit, 1.0))


def in_words(found: GapFinding) -> tuple[str, ...]:
    """Sentences that can be read alone."""
    return tuple(_sentences(found))


def _sentences(found: GapFinding) -> Iterator[str]:
    named = [effect for effect in found.effects if effect.name.effect != GEOMETRY]
    if any(effect.name.effect == GEOMETRY for effect in found.effects):
        yield "The nominal geometry does not fit this arm; it was identified with the effects (link_geometry)."
    for effect in named:
        if effect.is_nothing:
            yield f"Not there: {effect.name}, which the arm's file has; it is removed."
        else:
            yield f"Named: {effect.name} ({parameters_text(effect)})."
    if not named and found.unknown is None and not found.ambiguous:
        yield "Nothing is named: apart from the geometry, no known effect is needed to explain this data."
    for names in found.ambiguous:
        yield f"This data cannot distinguish {listed(names)}; none of them is named.{_shared(found, names)}"
    if found.unknown is not None:
        yield f"Unknown: {found.unknown.where}.{_nearest(found.unknown)}"
    after = "at the noise" if found.gap_after <= AT_FLOOR else f"{found.gap_after:.2f} times the noise"
    if math.isnan(found.gap_after):
        after = "not evaluated for the joint findings of poses and time series"
    if math.isnan(found.gap_before):
        yield f"The gap could not be evaluated: on {found.judged_on} nothing moves that any channel shows."
    else:
        yield f"The gap on {found.judged_on}: {found.gap_before:.2f} times the noise before, {after} after."
    if "turn_rad" in found.noise_floor:
        yield (
            "Measured orientations count beside the tip, each by its own noise:"
            f" {1e3 * found.noise_floor['turn_rad']:.2g} mrad about an axis, {1e3 * found.noise_floor['tip_m']:.2g} mm along one."
        )
    yield from _departing(found)
    yield from _maps(found)
    blind = [one.name for one in found.nameable if not one.is_nameable and one.name not in {n.name for n in named}]
    if blind:
        yield (
            f"This data could not name {_some(blind)} of usual size (too small beside the noise, or indistinguishable from"
            " others)."
        )
    if found.next_experiment:
        yield found.next_experiment


def _shared(found: GapFinding, names: Sequence[EffectName]) -> str:
    """The map of what a set of effects shares, where it has one."""
    maps = () if found.maps is None else found.maps.maps
    joints = {name.joint for name in names}
    own = [str(one) for one in maps if one.corrects == "angle_rad" and one.joint in joints]
    return f" Their common part is in arm.toml as a map: {' and '.join(own)}." if own else ""


def _departing(found: GapFinding) -> Iterator[str]:
    """How much of what arm.toml leaves is no riddle: named parts depart from their laws."""
    if found.gap_after > AT_FLOOR and found.gap_after > UNTOLD * found.gap_explained:
        yield (
            "arm.toml has the laws alone; with the departures of these parts from them"
            f" {found.gap_explained:.2f} times the noise would remain. Measured maps (--map) hold more."
        )


def _maps(found: GapFinding) -> Iterator[str]:
    """What was measured as maps, apart from all names."""
    if found.maps is None or not found.maps.maps:
        return
    yield f"Measured as maps, which correct without a cause: {', '.join(map(str, found.maps.maps))}."
    for one in found.maps.checks:
        unit, factor = unit_of(one.channel)
        unit += " at the tip" if one.joint is None else f" on joint {one.joint}"
        yield (
            f"On recordings that were not fitted, arm.toml leaves {factor * one.before:.3g} {unit} without its maps and"
            f" {factor * one.after:.3g} with them."
        )


def _nearest(unknown: Unknown) -> str:
    """What comes nearest; nothing of an effect whose own failing the unknown is."""
    if unknown.nearest is not None and str(unknown.nearest) in unknown.where:
        return ""
    if unknown.nearest is None or unknown.explained < NEAR:
        return " No known effect explains it."
    share = min(100.0 * unknown.explained, 99.0)
    return (
        f" The nearest known effect, {unknown.nearest}, explains {share:.0f} % of the residual, but not the rest; it is not"
        " named."
    )


def parameters_text(effect: NamedEffect) -> str:
    """As `width_rad = 0.0051 +- 0.0001`."""
    return ", ".join(
        f"{name} = {value:.4g}" + (f" +- {sd:.2g}" if sd == sd else "") for name, (value, sd) in effect.parameters.items()
    )


def _some(names: Sequence[EffectName]) -> str:
    """All where they are few; else the kinds, with how many of each."""
    if len(names) <= LISTED_MOST:
        return listed(names)
    kinds = Counter(one.effect for one in names)
    texts = [f"{kind} ({count})" if count > 1 else kind for kind, count in kinds.items()]
    return f"{len(names)} effects: {', '.join(texts)},"


def listed(names: Sequence[EffectName]) -> str:
    """A, b and c."""
    texts = [str(name) for name in names]
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}"
