"""Which recording would settle what is open, in a sentence."""

from __future__ import annotations

from collections.abc import Sequence

from calib.gap.finding import EffectName, Nameable, OpenQuestion, Remainder, Unknown

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

AGAIN = "Look there, and repeat the recording in another order to see whether it comes back."


def next_experiment(
    ambiguous: Sequence[Sequence[EffectName]],
    unknown: Unknown | None,
    could: Sequence[Nameable],
    has_free: bool,
) -> str | None:
    """A sentence, or None if nothing is open."""
    if ambiguous:
        return _apart(ambiguous[0])
    if unknown is not None:
        return f"What is left ({unknown.where}) is not in the list of effects. {AGAIN}"
    hidden = [one for one in could if not one.is_nameable]
    if not hidden:
        return None
    names = _listed([str(one.name) for one in hidden[:4]]) + (" and others" if len(hidden) > 4 else "")
    free = "" if has_free else "a dozen or more free poses away from the table, seen by the camera; "
    wanted = dict.fromkeys(
        TOLD_APART_BY[one.name.effect] for one in hidden if one.name.effect in TOLD_APART_BY
    )
    return f"To name {names}, record {free}{'; '.join(list(wanted)[:3])}."


def open_questions(
    ambiguous: Sequence[Sequence[EffectName]], remainder: Sequence[Remainder]
) -> tuple[OpenQuestion, ...]:
    """Each set that is ambiguous, and each remainder, with the recording that would settle it."""
    sets = [
        OpenQuestion(f"{_listed([str(name) for name in names])}?", _apart(names))
        for names in ambiguous
        if names
    ]
    known = {" or ".join(map(str, names)) for names in ambiguous}
    left = [OpenQuestion(f"{one.where}: what is it?", AGAIN) for one in remainder if one.where not in known]
    return (*sets, *left)


def _apart(names: Sequence[EffectName]) -> str:
    wanted = dict.fromkeys(TOLD_APART_BY[name.effect] for name in names if name.effect in TOLD_APART_BY)
    return f"To tell {_listed([str(name) for name in names])} apart, record {'; '.join(wanted)}."


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
