"""Which recording would settle what is open, in a sentence."""

from __future__ import annotations

from collections.abc import Sequence

from calib.gap.effects.catalogue import told_apart_by
from calib.gap.finding import EffectName, Nameable, OpenQuestion, Remainder, Unknown

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
        return f"The residual ({unknown.where}) is not in the list of effects. {AGAIN}"
    hidden = [one for one in could if not one.is_nameable]
    if not hidden:
        return None
    names = _listed([str(one.name) for one in hidden[:4]]) + (" and others" if len(hidden) > 4 else "")
    free = "" if has_free else "a dozen or more free poses away from the table, seen by the camera; "
    wanted = told_apart_by([one.name.effect for one in hidden])
    return f"To name {names}, record {free}{'; '.join(wanted[:3])}."


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
    wanted = told_apart_by([name.effect for name in names])
    return f"To tell {_listed([str(name) for name in names])} apart, record {'; '.join(wanted)}."


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
