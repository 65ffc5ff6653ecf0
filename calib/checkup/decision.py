"""From causes and their probabilities to what to do: nothing, recalibrate, or look at a joint."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.checkup.causes import Judged, judged, misfit_limit
from calib.checkup.expectation import Expectation

SURE: Final = 0.9  # probability from which one decision is given
SLIP_rad: Final = (
    0.008  # of a zero: settling and temperature move it by less, a slipped coupling or a lost tooth by more
)
BENT_m: Final = 0.003  # of the tip, by one link: more than parts settle
LEFT_MOST: Final = (
    0.05  # of chi-squared if nothing had changed: a cause that leaves less is one, whatever else there is
)
CAUSES_NAMED: Final = 3

FINE, RECALIBRATE = "fine", "recalibrate"


@dataclass(frozen=True, slots=True)
class Decision:
    """`action`: fine, recalibrate, or "inspect joint 2"; its probability; other actions that are left open, with theirs.

    is_one_cause: the first cause explains most; is_all: it explains everything. expected_m: root mean square of what the tips
    may be off by if nothing has changed; left_m: of what was measured.
    """

    action: str
    probability: float
    open: tuple[tuple[str, float], ...]
    causes: tuple[Judged, ...]
    is_one_cause: bool
    is_all: bool
    expected_m: float
    left_m: float
    poses_count: int

    @property
    def is_sure(self) -> bool:
        """Whether one action has most of the probability."""
        return self.probability >= SURE


def decide(at: Expectation) -> Decision:
    """By poses that were measured."""
    found = judged(at)
    single = next(one for one in found if one.cause.kind != "several")
    unchanged = next(one.misfit for one in found if one.cause.kind == "nothing")
    is_one_cause = found[0] is single or single.misfit <= LEFT_MOST * unchanged
    noise_m = math.sqrt(float(np.mean(np.trace(at.scatter_m2, axis1=1, axis2=2))))
    actions: dict[str, float] = {}
    for one in found:
        is_several = one.cause.kind == "several"
        action = action_of(single if is_several and is_one_cause else one, noise_m)
        actions[action] = actions.get(action, 0.0) + one.probability
    first, *others = sorted(actions.items(), key=lambda item: -item[1])
    return Decision(
        first[0],
        first[1],
        tuple((action, share) for action, share in others if share >= 1.0 - SURE),
        tuple(one for one in found if one.cause.kind != "several")[:CAUSES_NAMED],
        is_one_cause,
        found[0] is single and single.misfit <= misfit_limit(3 * len(at)),
        math.sqrt(float(np.trace(at.covariance)) / len(at)),
        math.sqrt(float(np.mean(np.sum(at.left_m**2, axis=1)))),
        len(at),
    )


def action_of(one: Judged, noise_m: float) -> str:
    """What a cause calls for. A change that is smaller than a visit's scatter is none."""
    kind, number = one.cause.kind, one.cause.number
    if kind == "nothing" or one.shift_m < noise_m:
        return FINE
    if kind in ("play", "load"):
        return f"inspect joint {number}"
    if kind == "zero" and abs(float(one.amplitudes[0])) > SLIP_rad:
        return f"inspect joint {number}"
    if kind == "link" and one.shift_m > BENT_m:
        return f"inspect link {number}"
    return RECALIBRATE


def words_of(one: Judged) -> str:
    """A cause in words, with its size."""
    kind, number = one.cause.kind, one.cause.number
    size = f"{1e3 * abs(float(one.amplitudes[0])):.2g} mrad" if kind in ("zero", "play", "load") else ""
    shift = f"{1e3 * one.shift_m:.2g} mm at the tip"
    texts = {
        "nothing": "nothing has changed",
        "zero": f"the zero of joint {number} has moved by {size}",
        "play": f"the play of joint {number} has changed by {size}",
        "load": f"joint {number} gives way under load by {size} more at its largest load",
        "link": f"link {number} has another shape ({shift})",
        "frame": f"the base or the camera has moved ({shift})",
    }
    return texts[kind]


def sentences(found: Decision) -> tuple[str, ...]:
    """The decision in words."""
    return tuple(_sentences(found))


def _sentences(found: Decision) -> Iterator[str]:
    yield (
        f"{found.poses_count} visits: the tip is {1e3 * found.left_m:.2g} mm from where it is expected; if nothing has changed,"
        f" {1e3 * found.expected_m:.2g} mm are usual (root mean square)."
    )
    first = found.causes[0]
    if not found.is_one_cause:
        yield f"Recalibrate: no single cause explains it; nearest: {words_of(first)}."
        return
    if found.is_sure:
        yield f"{found.action.capitalize()} ({_percent(found.probability)}): {words_of(first)}."
        if found.action.startswith("inspect"):
            yield _advice(first)
        if not found.is_all:
            yield "It does not explain everything: something smaller may have changed as well."
        return
    options = [(found.action, found.probability), *found.open]
    told = " or ".join(f"{action} ({_percent(share)})" for action, share in options)
    yield f"Not sure: {told}. Likely: {_listed(found.causes)}. Run it again with more --poses."


def _advice(first: Judged) -> str:
    number = first.cause.number
    match first.cause.kind:
        case "zero":
            return f"Look for a slipped coupling, encoder or belt of joint {number}; then home and calibrate."
        case "play":
            return (
                f"Look for wear or a loose fit in the gear of joint {number}; then calibrate, and run `gap`."
            )
        case "load":
            return f"Look for a loose screw, clamp or belt at joint {number}; then calibrate, and run `gap`."
        case _:
            return f"Look whether link {number} is bent or loose; then calibrate."


def _listed(causes: Sequence[Judged]) -> str:
    return "; ".join(
        f"{words_of(one)} ({_percent(one.probability)})" for one in causes if one.probability >= 0.01
    )


def _percent(share: float) -> str:
    return "> 99 %" if share > 0.99 else f"{100 * share:.0f} %"


def decision_json(found: Decision) -> dict[str, object]:
    """For programs; SI units."""
    return {
        "format": "checkup/1",
        "action": found.action if found.is_sure else "not sure",
        "likeliest": found.action,
        "probability": found.probability,
        "open": [{"action": action, "probability": share} for action, share in found.open],
        "causes": [
            {
                "kind": one.cause.kind,
                "number": one.cause.number or None,
                "probability": one.probability,
                "amplitudes": one.amplitudes.tolist(),
                "shift_rms_m": one.shift_m,
            }
            for one in found.causes
        ],
        "visits": found.poses_count,
        "expected_rms_m": found.expected_m,
        "left_rms_m": found.left_m,
        "in_words": list(sentences(found)),
    }
