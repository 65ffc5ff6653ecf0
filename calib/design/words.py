"""Summary of a plan in sentences for the operator."""

from __future__ import annotations

import numpy as np

from calib.design.boards import OTHER_TILTS
from calib.design.candidates import FREE
from calib.design.information import Uncertainty
from calib.design.plan import Alternative, Plan

NOTICEABLE = 0.03  # uncertainties that differ by less than this share count as equal


def in_words(plan: Plan) -> tuple[str, ...]:
    """Gain of the plan, alternatives, what stays undetermined, and notes."""
    return (_gain(plan), *_alternatives(plan), *_open(plan), *_notes(plan))


def length(metres: float) -> str:
    """A length such as 0.153 mm, with three digits."""
    return f"{1e3 * metres:#.3g}".rstrip(".") + " mm"


def known_to(state: Uncertainty) -> str:
    """The least certain parameter, as `theta3 to 0.042 deg`."""
    sd = state.least_known_sd
    if state.least_known_unit == "m":
        return f"{state.least_known} to {length(sd)}"
    return f"{state.least_known} to {np.degrees(sd):.2g} deg"


def kind(setup: str, count: int) -> str:
    """As `12 free poses` or `9 cavities on roll`."""
    if setup == FREE:
        return f"{count} free pose{'s' if count > 1 else ''}"
    return f"{count} cavit{'ies' if count > 1 else 'y'} on {setup}"


def _gain(plan: Plan) -> str:
    before, after = plan.before, plan.after
    start = length(before.tip_m) if before.points_count else f"{length(before.tip_m)} (bounds only)"
    return (
        f"These {len(plan.poses)} poses reduce the tip's uncertainty over the workspace from {start} to"
        f" {length(after.tip_m)}, at the worst pose from {length(before.tip_worst_m)} to {length(after.tip_worst_m)}."
        f" Least certain parameter: {known_to(before)} before, {known_to(after)} after."
    )


def _alternatives(plan: Plan) -> list[str]:
    """Comparison of kinds, and of roll with pitch, by a few poses of each."""
    few = {one.setup: one for one in sorted(plan.alternatives, key=lambda one: -one.count)}
    ranked = sorted(few.values(), key=lambda one: one.after.tip_m)
    sentences = []
    if len(ranked) > 1:
        parts = ", ".join(f"{kind(one.setup, one.count)} {length(one.after.tip_m)}" for one in ranked)
        sentences.append(f"Uncertainty with one kind alone: {parts}.")
    if FREE in few and set(plan.points.setup) != {FREE}:
        sentences += _free_alone(plan, few[FREE])
    if "roll" in few and "pitch" in few:
        sentences.append(_compared(few["roll"], few["pitch"]))
    return sentences


def _free_alone(plan: Plan, free: Alternative) -> list[str]:
    """Whether free poses alone suffice, without the board."""
    is_enough = free.after.tip_m <= (1.0 + NOTICEABLE) * plan.after.tip_m
    if not is_enough or free.count > len(plan.poses):
        return []
    return [f"{kind(FREE, free.count)} alone are as good, without the board (--only free)."]


def _compared(one: Alternative, other: Alternative) -> str:
    first, second = sorted((one, other), key=lambda a: a.after.tip_m)
    if first.after.tip_m > (1.0 - NOTICEABLE) * second.after.tip_m:
        return f"A {first.setup} tilt gains as much as a {second.setup} tilt."
    return (
        f"A {first.setup} tilt gains more than a {second.setup} tilt: {length(first.after.tip_m)} against"
        f" {length(second.after.tip_m)}."
    )


def _open(plan: Plan) -> list[str]:
    """What the whole plan leaves undetermined."""
    rank, total = plan.after.rank, plan.combinations_count
    if rank >= total:
        return []
    return [
        f"These poses determine {rank} of the {total} parameter combinations that move the tip; the others keep their"
        " bounds as uncertainty."
    ]


def _notes(plan: Plan) -> list[str]:
    sentences = []
    if not plan.is_tied:
        sentences.append(
            "The arm's base is not tied to a known place: the uncertainty excludes a rigid motion of the whole workspace."
        )
    new = [setup for setup in OTHER_TILTS if setup in plan.points.setup]
    if new:
        sentences.append(
            f"The identification needs the board's pose in {', '.join(new)}: use `armwright register`, or set"
            " known_pose = false in [table]."
        )
    for before, after in plan.blocked:
        sentences.append(
            f"Between free poses {before} and {after} a straight joint move hits the floor or the board: take a detour."
        )
    return sentences
