"""What to record next, to settle what a verdict on time series leaves open."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.gap.effects.catalogue import role_of
from calib.gap.finding import EffectName, OpenQuestion, Unknown
from calib.gap.series.answer import SeriesVerdict
from calib.gap.signals.recording import RunSet


def next_experiment(
    recording: RunSet, sets: Sequence[Sequence[EffectName]], unknown: Unknown | None
) -> str | None:
    """What to record where something is open."""
    if sets:
        return _to_separate(recording, sets[0])
    if unknown is not None:
        advice = _advice(recording, unknown.where.startswith("the tip"))
        return f"To see more of what is left ({unknown.where}), record {advice}."
    return None


def open_questions(recording: RunSet, verdict: SeriesVerdict) -> tuple[OpenQuestion, ...]:
    """One for each set and each remainder."""
    sets = [
        OpenQuestion(f"Which of {', '.join(map(str, names))} is it?", _to_separate(recording, names))
        for names in verdict.ambiguous
    ]
    rest = [
        OpenQuestion(
            f"What is it that shows in {one.where}?",
            f"Record {_advice(recording, one.where.startswith('the tip'))}.",
        )
        for one in verdict.remainder
    ]
    return (*sets, *rest)


def _to_separate(recording: RunSet, names: Sequence[EffectName]) -> str:
    is_of_tip = any(role_of(name.effect) == "angle" for name in names)
    return f"To separate {', '.join(map(str, names))}, record {_advice(recording, is_of_tip)}."


def _advice(recording: RunSet, is_of_tip: bool = True) -> str:
    """What these runs lack; a camera only where it would see what is asked."""
    if is_of_tip and not recording.has_tip:
        return "the same runs with the camera on the tip"
    if not recording.has_current:
        return "the same runs with the motor currents"
    loads = {round(float(np.median(run.payload_kg)), 3) for run in recording.runs}
    if len(loads) < 2:
        return "the same runs with a known payload at the tip"
    return "slow ramps and reversals at several speeds, each twice, with and without payload"
