"""A finding that does not contradict itself: what is named is in no set of what may be, and what is left is not passed over."""

from __future__ import annotations

import dataclasses
import math

from calib.gap.finding import GapFinding, Unknown

# Times the noise, on recordings that were not fitted, from which on a gap is not passed over in silence: three quarters of what
# is left, squared, is then something else than noise.
PASSED_OVER = 2.0
MORE = "Record more runs, slow and fast, each motion twice: these do not say more."
CHANNELS = {
    "current_A": "the motors' currents",
    "voltage_V": "the motors' voltages",
    "tip_m": "the tip",
    "turn_rad": "the tip's orientation",
}  # those that name effects


def consistent(found: GapFinding) -> GapFinding:
    """The same without sets that a name has settled, and with what is left said where nothing else says it."""
    named = {effect.name for effect in found.effects}
    sets = tuple(names for names in found.ambiguous if not named.intersection(names))
    settled = (
        found if sets == found.ambiguous else dataclasses.replace(found, ambiguous=sets, next_experiment=MORE)
    )
    is_silent = found.unknown is None and not sets and not found.remainder
    if is_silent and found.unexplained > PASSED_OVER:
        return dataclasses.replace(settled, unknown=Unknown(_left(settled), None, 0.0), next_experiment=MORE)
    return settled


def _left(found: GapFinding) -> str:
    """How much is left, and in which channel most of it."""
    times = {
        channel: found.after_si.get(channel, math.nan) / floor
        for channel, floor in found.noise_floor.items()
        if channel in CHANNELS and floor > 0.0
    }
    seen = {channel: value for channel, value in times.items() if math.isfinite(value)}
    if not seen:
        return f"{found.unexplained:.1f} times the noise"
    channel = max(seen, key=lambda key: seen[key])
    return f"{CHANNELS[channel]}, {seen[channel]:.1f} times the noise"
