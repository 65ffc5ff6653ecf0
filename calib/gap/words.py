"""What the gap workflow found, in sentences: the answer first."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence

from calib.gap.effects.catalogue import follows_map
from calib.gap.finding import GEOMETRY, EffectName, GapFinding, NamedEffect, Unknown
from calib.gap.posterior.constants import AT_FLOOR, NEAR, UNTOLD, CHECKED_sd
from control.model.effects import EFFECTS

LISTED_MOST = 6  # of names in a sentence


_UNITS = {"m": ("mm", 1e3), "A": ("mA", 1e3), "V": ("mV", 1e3), "rad": ("mrad", 1e3), "Nm": ("N m", 1.0)}


def unit_of(channel: str) -> tuple[str, float]:
    """The unit in which a reader sees a channel, and its factor: `tip_m` in mm."""
    unit = channel.rpartition("_")[2]
    return _UNITS.get(unit, (unit, 1.0))


def in_words(finding: GapFinding) -> tuple[str, ...]:
    """Sentences that can be read alone."""
    return tuple(_sentences(finding))


def _sentences(finding: GapFinding) -> Iterator[str]:
    named = [effect for effect in finding.effects if effect.name.effect != GEOMETRY]
    if any(effect.name.effect == GEOMETRY for effect in finding.effects):
        yield "The nominal geometry does not fit this arm; it was identified with the effects (link_geometry)."
    for effect in named:
        if effect.is_nothing:
            yield f"Not there: {effect.name}, which the arm's file has; it is removed."
        else:
            yield f"Named: {effect.name} ({parameters_text(effect)})."
    if finding.refitted:
        values = "; ".join(f"{effect.name} ({parameters_text(effect)})" for effect in finding.refitted)
        yield f"Identified anew beside these, as arm.toml has it already: {values}."
    if not named and finding.unknown is None and not finding.ambiguous:
        yield "Nothing is named: apart from the geometry, no known effect is needed to explain this data."
    for names in finding.ambiguous:
        yield f"This data cannot distinguish {listed(names)}; none of them is named.{_shared(finding, names)}"
    if finding.unknown is not None:
        yield f"Unknown: {finding.unknown.where}.{_nearest(finding.unknown)}"
    after = "at the noise" if finding.gap_after <= AT_FLOOR else f"{finding.gap_after:.2f} times the noise"
    if math.isnan(finding.gap_after):
        after = "not evaluated for the joint findings of poses and time series"
    if math.isnan(finding.gap_before):
        yield f"The gap could not be evaluated: on {finding.judged_on} nothing moves that any channel shows."
    else:
        yield f"The gap on {finding.judged_on}: {finding.gap_before:.2f} times the noise before, {after} after."
    if "turn_rad" in finding.noise_floor:
        yield (
            "Measured orientations count beside the tip, each by its own noise:"
            f" {1e3 * finding.noise_floor['turn_rad']:.2g} mrad about an axis,"
            f" {1e3 * finding.noise_floor['tip_m']:.2g} mm along one."
        )
    yield from _departing(finding)
    yield from _maps(finding)
    blind = [entry.name for entry in finding.nameable if not entry.is_nameable and entry.name not in {n.name for n in named}]
    if blind:
        why = "too small beside the noise, or indistinguishable from others"
        yield f"This data could not name {_listed_short(blind)} of usual size ({why})."
    if finding.next_experiment:
        yield finding.next_experiment


def _shared(finding: GapFinding, names: Sequence[EffectName]) -> str:
    """The map of what a set of effects shares, where it has one."""
    maps = () if finding.maps is None else finding.maps.maps
    joints = {name.joint for name in names}
    common = [str(correction) for correction in maps if correction.corrects == "angle_rad" and correction.joint in joints]
    return f" Their common part is in arm.toml as a map: {' and '.join(common)}." if common else ""


def _departing(finding: GapFinding) -> Iterator[str]:
    """How much of what arm.toml leaves is no riddle: named parts depart from their laws."""
    if finding.gap_after > AT_FLOOR and finding.gap_after > UNTOLD * finding.gap_explained:
        departing = [effect.name.effect for effect in finding.effects if effect.departure > 0.0]
        is_in_maps = not departing or any(map(follows_map, departing))
        more = "Measured maps (--map) hold more." if is_in_maps else "No map follows these."
        yield (
            "arm.toml has the laws alone; with the departures of these parts from them, and plays on their flanks,"
            f" {finding.gap_explained:.2f} times the noise would remain. {more}"
        )


def _maps(finding: GapFinding) -> Iterator[str]:
    """What was measured as maps, apart from all names."""
    if finding.maps is None or not finding.maps.maps:
        return
    yield f"Measured as maps, which correct without a cause: {', '.join(map(str, finding.maps.maps))}."
    for check in finding.maps.checks:
        unit, factor = unit_of(check.channel)
        unit += " at the tip" if check.joint is None else f" on joint {check.joint}"
        yield (
            f"On recordings that were not fitted, arm.toml leaves {factor * check.before:.3g} {unit} without its maps and"
            f" {factor * check.after:.3g} with them."
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
    """As `width_rad = 0.0051 +- 0.0001`; what lies further from the file's value on one side, as `2.02 (0 to 2.42)`."""
    return ", ".join(f"{name} = {_with_doubt(effect, name)}" for name in effect.parameters)


def _with_doubt(effect: NamedEffect, name: str) -> str:
    value, sd = effect.parameters[name]
    if math.isnan(sd):
        return f"{value:.4g}"
    lower, upper = interval(effect, name)
    is_even = max(upper - value, value - lower) <= math.sqrt(2.0) * min(upper - value, value - lower)  # apart by one sd at most
    return f"{value:.4g} +- {sd:.2g}" if is_even else f"{value:.4g} ({lower:.3g} to {upper:.3g})"


def interval(effect: NamedEffect, name: str) -> tuple[float, float]:
    """What a parameter lies between, at CERTAIN probability.

    The standard deviation counts how far the file's value is from the one beside all that has no name: it does so on that one's
    side. What is there and cannot be below nought ends there.
    """
    value, sd = effect.parameters[name]
    apart = effect.beside.get(name, value) - value
    if name == "phase_rad":
        apart = math.remainder(apart, 2.0 * math.pi)
    own = math.sqrt(max(sd**2 - apart**2, 0.0))
    below, above = (sd, own) if apart < 0.0 else (own, sd)
    kind = EFFECTS.get(effect.name.effect)
    least = 0.0 if kind is not None and name in (*kind.positive, *kind.not_negative) else -math.inf
    return max(value - CHECKED_sd * below, least), value + CHECKED_sd * above


def _listed_short(names: Sequence[EffectName]) -> str:
    """All where they are few; else the kinds, with how many of each."""
    if len(names) <= LISTED_MOST:
        return listed(names)
    kinds = Counter(name.effect for name in names)
    texts = [f"{kind} ({count})" if count > 1 else kind for kind, count in kinds.items()]
    return f"{len(names)} effects: {', '.join(texts)},"


def listed(names: Sequence[EffectName]) -> str:
    """A, b and c."""
    texts = [str(name) for name in names]
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}"
