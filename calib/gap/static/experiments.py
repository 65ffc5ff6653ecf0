"""Which recording would settle what is open, in a sentence."""

from __future__ import annotations

from collections.abc import Sequence

from calib.gap.finding import EffectName, Nameable, Unknown
from calib.gap.static.nameable import is_nameable

TOLD_APART_BY = {
    "backlash": "the same poses from both approaches, some where gravity on that joint changes its sign",
    "joint_compliance": "the same poses with and without a known payload",
    "encoder_scale": "poses over the whole travel of that joint",
    "encoder_eccentricity": "poses over more than 120 degrees of that joint",
    "belt_coupling": "poses in which joint 2 moves while joint 3 stands",
    "link_flexure": "markers at both ends of that link, with and without a known payload",
    "base_frame": "markers on the arm's base, or the board seated anew",
    "payload": "holding currents from both directions, with two known masses",
    "torque_constant": "holding currents from both directions, with two known masses",
    "link_inertia": "holding currents from both directions, with two known masses",
    "thermal_drift": "the same reference pose every few minutes, the others in shuffled order",
}


def next_experiment(
    ambiguous: Sequence[Sequence[EffectName]],
    unknown: Unknown | None,
    could: Sequence[Nameable],
    has_free: bool,
) -> str | None:
    """A sentence, or None if nothing is open."""
    if ambiguous:
        rivals = ambiguous[0]
        wanted = dict.fromkeys(TOLD_APART_BY[name.effect] for name in rivals if name.effect in TOLD_APART_BY)
        return f"To tell {_listed([str(name) for name in rivals])} apart, record {'; '.join(wanted)}."
    if unknown is not None:
        return (
            f"What is left ({unknown.where}) is not in the list of effects: look there, and repeat the recording in another"
            " order to see whether it comes back."
        )
    hidden = [one for one in could if not is_nameable(one)]
    if not hidden:
        return None
    names = _listed([str(one.name) for one in hidden[:4]]) + (" and others" if len(hidden) > 4 else "")
    free = "" if has_free else "a dozen or more free poses away from the table, seen by the camera; "
    wanted = dict.fromkeys(
        TOLD_APART_BY[one.name.effect] for one in hidden if one.name.effect in TOLD_APART_BY
    )
    return f"To name {names}, record {free}{'; '.join(list(wanted)[:3])}."


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
