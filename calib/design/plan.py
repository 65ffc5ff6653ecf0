"""What to record next: the plan as a record, and what it says; plan.csv, plan.json and sentences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.design.candidates import OTHER_TILTS
from calib.design.information import Uncertainty
from calib.points.points import FREE, Points, make_points
from calib.points.writer import write_points
from calib.results import entries, write_json


@dataclass(frozen=True, slots=True)
class PlannedPose:
    """One pose of the plan: q_rad by the nominal arm; `visit` from 1.

    gain: increase of log det when added to the previous ones of the plan; `after`: the uncertainty then.
    """

    setup: str
    point: str
    repeat: int
    q_rad: tuple[float, ...]
    visit: int
    gain: float
    after: Uncertainty


@dataclass(frozen=True, slots=True)
class Alternative:
    """The result of the best `count` poses, or all, of one kind alone: cavities of one setup, or free poses."""

    setup: str
    count: int
    gain: float
    after: Uncertainty


@dataclass(frozen=True, slots=True)
class Plan:
    """What to record next. `poses` in order of value, `points` in visiting order."""

    criterion: str
    noise_m: float
    poses: tuple[PlannedPose, ...]
    points: Points
    before: Uncertainty
    alternatives: tuple[Alternative, ...]
    candidates: Mapping[str, int]
    combinations_count: int
    is_tied: bool
    blocked: tuple[tuple[str, str], ...]

    @property
    def after(self) -> Uncertainty:
        """Uncertainty after the whole plan."""
        return self.poses[-1].after


FORMAT = "plan/1"


def write_plan(folder: Path, plan: Plan, arm: str) -> tuple[Path, Path]:
    """Write plan.csv (setup, point, repeat, q1_rad ... in visiting order) and plan.json; returns their paths."""
    table, text = folder / "plan.csv", folder / "plan.json"
    points = plan.points
    nowhere = np.full((len(points), 3), np.nan)  # tips are yet to be measured
    write_points(table, make_points(points.setup, points.point, points.repeat, points.q_rad, nowhere))
    write_json(text, plan_json(plan, arm))
    return table, text


def plan_json(plan: Plan, arm: str) -> dict[str, object]:
    """The plan for other programs: SI units; poses in order of value, `visit` is the visiting order."""
    return {
        "format": FORMAT,
        "arm": arm,
        "criterion": plan.criterion,
        "noise_m": plan.noise_m,
        "candidates": plan.candidates,
        "combinations": plan.combinations_count,
        "is_tied_to_base": plan.is_tied,
        "before": _state(plan.before),
        "after": _state(plan.after),
        "points": [
            entries(pose, "setup", "point", "repeat", "q_rad", "visit") | {"log_det_gain": pose.gain, "after": _state(pose.after)}
            for pose in plan.poses
        ],
        "alternatives": [
            {"setup": one.setup, "points": one.count, "log_det_gain": one.gain, "after": _state(one.after)}
            for one in plan.alternatives
        ],
        "not_clear_between": plan.blocked,
        "in_words": in_words(plan),
    }


def _state(state: Uncertainty) -> dict[str, object]:
    return {
        "points": state.points_count,
        "observability": state.indices.as_dict(),
        **entries(state, "log_det", "rank", "tip_m", "tip_worst_m"),
        "least_known": {"name": state.least_known, "sd": state.least_known_sd, "unit": state.least_known_unit},
    }


NOTICEABLE = 0.03  # uncertainties that differ by less than this share count as equal


def in_words(plan: Plan) -> tuple[str, ...]:
    """Gain of the plan, alternatives, what stays undetermined, and notes."""
    return (_gain(plan), *_alternatives_in_words(plan), *_open(plan), *_notes(plan))


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


def _alternatives_in_words(plan: Plan) -> list[str]:
    """Comparison of kinds, and of roll with pitch, by a few poses of each."""
    few = {alone.setup: alone for alone in sorted(plan.alternatives, key=lambda alone: -alone.count)}
    ranked = sorted(few.values(), key=lambda alone: alone.after.tip_m)
    sentences = []
    if len(ranked) > 1:
        parts = ", ".join(f"{kind(alone.setup, alone.count)} {length(alone.after.tip_m)}" for alone in ranked)
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
