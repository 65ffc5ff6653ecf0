"""What a plan brings, and why, in sentences."""

from __future__ import annotations

import math
from collections.abc import Iterator

from calib.planning.cost import Cost
from calib.planning.path import PathPlan, WayOfPath
from calib.planning.place import NOWHERE
from calib.planning.stops import StopsPlan, WayOfStops
from calib.trust.task import Reliability

Plan = PathPlan | StopsPlan


def sentences(plan: Plan, tasks: tuple[Reliability, Reliability] | None) -> tuple[str, ...]:
    """The gain first, then what was changed, then what is left. `tasks`: the probability as given and as planned."""
    return tuple(_sentences(plan, tasks))


def _sentences(plan: Plan, tasks: tuple[Reliability, Reliability] | None) -> Iterator[str]:
    before, after = plan.plain.cost, plan.chosen.cost
    if plan.steps:
        share = 100.0 * (1.0 - after.rms_m / before.rms_m)
        yield (
            f"Expected error of the tip: {_mm(before.rms_m)} as given, {_mm(after.rms_m)} as planned"
            f" ({share:.0f} % less; root mean square)."
        )
    else:
        yield (
            f"Expected error of the tip: {_mm(before.rms_m)} (root mean square). No change is sure to make it smaller, so the"
            " plan is the task as given."
        )
    error_m = before.rms_m
    for name, after_m in plan.steps:
        yield f"{name.capitalize()}: {_mm(error_m)} to {_mm(after_m)}{_detail(name, plan.chosen)}."
        error_m = after_m
    yield _left(after)
    if isinstance(plan, StopsPlan) and plan.chosen.order != plan.plain.order:
        yield (
            f"Order of the points: {', '.join(str(row + 1) for row in plan.chosen.order)}; joint travel"
            f" {plan.chosen.travel_rad:.2f} rad."
        )
    yield from _about_table(plan.chosen)
    if tasks is not None:
        given, planned = tasks
        yield (
            f"{_mm(given.tolerance_m)} is kept with a probability of {100 * given.probability:.1f} % as given,"
            f" {100 * planned.probability:.1f} % as planned ({given.draws} draws)."
        )


def _detail(name: str, chosen: WayOfPath | WayOfStops) -> str:
    if name == "place":
        x, y, z = (1e3 * part for part in chosen.shift_m)
        return f", moved by ({x:.0f}, {y:.0f}, {z:.0f}) mm"
    if isinstance(chosen, WayOfStops):
        return ", each joint comes from the side that a lead-in gives it"
    if name == "branch":
        start_deg = ", ".join(f"{math.degrees(angle):.0f}" for angle in chosen.plan.q_start_rad)
        return f", {chosen.plan.branch or f'the joints start at ({start_deg}) deg'}"
    return ", the last way-point first" if name == "way round" else f", {chosen.pace:g} of the speed given"


def _left(cost: Cost) -> str:
    """The largest part of what is left, and what would help against it."""
    causes = (
        (cost.known_m, "known from the points, and not in the arm's file: `armwright calibrate`, then `armwright gap`"),
        (cost.unknown_m, "what the points do not tell: `armwright plan-poses` proposes more"),
        (cost.scatter_m, "scatter from visit to visit: play whose flank is unclear, noise"),
    )  # fmt: skip
    part_m, why = max(causes)
    return f"Most of what is left, {_mm(part_m)}, is {why}."


def _about_table(chosen: WayOfPath | WayOfStops) -> Iterator[str]:
    table = chosen.arm.table
    if chosen.shift_m != NOWHERE and table is not None and table.known_pose and table.origin_m is not None:
        x, y, z = table.origin_m
        yield f"If the work is on the table, move it too: origin_m = [{x:.4f}, {y:.4f}, {z:.4f}] in [table] of arm.toml."


def _mm(length_m: float) -> str:
    return f"{1e3 * length_m:.3g} mm"
