"""The result in sentences and as text."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.trust.iso9283 import PoseFigures, pose_rows
from calib.trust.task import Reliability
from calib.trust.trust import Trust, share_within

LISTED = 6
POSE_HEAD = ("ISO 9283", "visits", "AP_p predicted [mm]", "measured", "RP_l predicted [mm]", "measured")
CORRECTABLE = 2.0  # expected over uncertain error, from which the file is worth correcting
COVERED_LEAST = 0.9  # of held-out poses inside 95 % ellipsoids: with fewer, the intervals are too narrow


def sentences(trust: Trust) -> tuple[str, ...]:
    """What the map says, the most useful first."""
    return tuple(_sentences(trust))


def _sentences(trust: Trust) -> Iterator[str]:
    reach = trust.within_95_m
    yield (
        f"The tip of arm {trust.arm.name} is within {_mm(np.median(reach))} of where its file puts it, in 95 % of visits"
        f" and at half of {len(reach)} poses over its workspace; at the worst pose within {_mm(reach.max())}."
    )
    if trust.request.tolerance_m is not None:
        share = share_within(reach, trust.request.tolerance_m)
        yield f"{100 * share:.0f} % of the poses keep {_mm(trust.request.tolerance_m)} in 95 % of visits."
    yield from _about_coverage(trust)
    expected = float(np.sqrt(np.mean(np.sum(trust.sheets[0].error.expected_m ** 2, axis=1))))
    uncertain = float(np.sqrt(np.mean(np.trace(trust.sheets[0].error.systematic_m2, axis1=1, axis2=2))))
    if expected > CORRECTABLE * uncertain:
        yield (
            f"Most of it can be corrected: {_mm(expected)} are known from these points (root mean square), {_mm(uncertain)}"
            " are not. Run `armwright calibrate`, then `armwright gap`."
        )
    elif trust.importances:
        first = min(trust.importances, key=lambda one: one.without_m)
        yield (
            f"Most of it is not known from these points: {_mm(uncertain)} (root mean square). If {first.name} were known,"
            f" {_mm(first.without_m)} would be left. `armwright plan-poses --criterion tip` proposes points."
        )
    if not trust.predictor.is_tied:
        yield "The arm's base is not tied to a known place: the errors exclude a rigid motion of the whole workspace."


def _about_coverage(trust: Trust) -> Iterator[str]:
    found = trust.coverage
    if found is None:
        yield "Too few points to leave some out: the intervals are not checked."
        return
    yield (
        f"Checked on points left out in turn: {found.inside} of {found.count} lie inside their 95 % ellipsoids"
        f" ({100 * found.share:.0f} %); predicted {_mm(found.predicted_m)}, found {_mm(found.left_m)} (root mean square)."
    )
    if found.share < COVERED_LEAST:
        yield (
            "The intervals are too narrow for these points: look for outliers (`armwright calibrate`) and effects"
            " (`armwright gap`)."
        )


def task_sentences(found: Reliability) -> tuple[str, ...]:
    """The probability of a task, and where it is worst."""
    low, high = found.interval
    q95 = float(np.quantile(found.largest_m, 0.95))
    return (
        f"The path keeps {_mm(found.tolerance_m)} with a probability of {100 * found.probability:.1f} %"
        f" ({100 * low:.1f} to {100 * high:.1f} %, {found.draws} draws).",
        f"Its largest error is {_mm(float(np.median(found.largest_m)))} in the median and below {_mm(q95)} in 95 % of"
        f" draws; on average it is largest at {found.worst_time_s:.2f} s of {found.duration_s:.2f} s.",
    )


def cause_rows(trust: Trust) -> list[tuple[str, str, str]]:
    """The causes that would help most if they were known: name, uncertain without them, expected [mm]."""
    best = sorted(trust.importances, key=lambda one: one.without_m)[:LISTED]
    return [(one.name, f"{1e3 * one.without_m:.3f}", f"{1e3 * one.expected_m:.3f}") for one in best]


def as_text(trust: Trust, tasks: tuple[Reliability, ...], poses: tuple[PoseFigures, ...]) -> str:
    """What the command prints."""
    lines = [*sentences(trust), *(line for one in tasks for line in task_sentences(one))]
    rows = [f"  {name:<28}{left:>14}{expected:>14}" for name, left, expected in cause_rows(trust)]
    head = f"  {'if this were known exactly':<28}{'left [mm]':>14}{'expected [mm]':>14}"
    return "\n".join([*lines, "", head, *rows, *_pose_lines(poses)]) + "\n"


def _pose_lines(poses: tuple[PoseFigures, ...]) -> list[str]:
    form = "  {:<14}{:>7}{:>28}{:>10}{:>26}{:>10}"
    rows = [form.format(*cells) for cells in pose_rows(poses)]
    return ["", form.format(*POSE_HEAD), *rows] if rows else []


def _mm(length_m: float) -> str:
    return f"{1e3 * float(length_m):.3g} mm"
