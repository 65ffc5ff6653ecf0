"""What a plan says and leaves on disk: sentences, way-points or poses, operator lines, task.json (docs/formats.md)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from calib.gap.plan.plan import GENTLE
from calib.points.points import FREE, make_points
from calib.points.writer import replace_file, write_points
from calib.results import Provenance, entries, write_json
from calib.task_planning import NOWHERE, Cost, PathPlan, StopsPlan, WayOfPath, WayOfStops
from calib.trust.prediction import Reliability
from control.motion.waypoints import ORIENTATION_COLUMNS, POSITION_COLUMNS, SPEED_COLUMN, Waypoints

FORMAT: Final = "task/1"
PATH, POSES, SCRIPT, RESULT = "path.csv", "poses.csv", "script.txt", "task.json"
RESULTS: Final = (PATH, POSES, SCRIPT, RESULT)
DWELL_s: Final = 0.5  # at a stop
COSTS: Final = ("rms_m", "known_m", "unknown_m", "scatter_m")

Tasks = tuple[Reliability, Reliability] | None


def write_plan(folder: Path, plan: Plan, tasks: Tasks, made: Provenance) -> None:
    """Write path.csv or poses.csv, script.txt and task.json."""
    if isinstance(plan, PathPlan):
        replace_file(folder / PATH, waypoints_text(plan.chosen.waypoints).encode())
        lines = path_lines(plan.chosen, folder / PATH)
    else:
        _write_poses(folder / POSES, plan.chosen)
        lines = stop_lines(plan.chosen)
    replace_file(folder / SCRIPT, "".join(f"{line}\n" for line in lines).encode())
    write_json(folder / RESULT, made.heading(FORMAT, arm=plan.plain.arm.name) | plan_json(plan, tasks))


def waypoints_text(waypoints: Waypoints) -> str:
    """Way-points as `armwright run` reads them."""
    columns, rows = [*POSITION_COLUMNS], [list(point) for point in waypoints.points]
    if waypoints.orientations is not None:
        columns += ORIENTATION_COLUMNS
        rows = [[*row, *turn] for row, turn in zip(rows, waypoints.orientations, strict=True)]
    if waypoints.speeds_m_s is not None:
        columns.append(SPEED_COLUMN)
        rows = [[*row, speed] for row, speed in zip(rows, waypoints.speeds_m_s, strict=True)]
    return "\n".join([",".join(columns), *(",".join(f"{x:.9g}" for x in row) for row in rows)]) + "\n"


def path_lines(way: WayOfPath, file: Path) -> list[str]:
    """Operator lines: to the lead-in, which also decides the branch, then the path."""
    return [f"move --joints {_angles(way.lead_in_rad)}", f"run {file}"]


def stop_lines(way: WayOfStops) -> list[str]:
    """Operator lines: to each lead-in, gently on to the point, and a wait there."""
    return list(_stop_lines(way))


def _stop_lines(way: WayOfStops) -> Iterator[str]:
    lead_in = way.lead_in_rad
    for row in way.order:
        yield f"# way-point {row + 1}"
        if way.has_lead_in[row]:
            yield f"move --joints {_angles(lead_in[row].tolist())}"
        yield f"move --joints {_angles(way.poses.q_rad[row].tolist())} --speed {GENTLE:g}"
        yield f"wait {DWELL_s:g}"


def _write_poses(file: Path, way: WayOfStops) -> None:
    """points.csv without tips, in visiting order: `armwright session --plan` takes it."""
    rows = list(way.order)
    names = [f"w{row + 1}" for row in rows]
    nowhere = np.full((len(rows), 3), np.nan)
    q, sides = way.poses.q_rad[rows], way.poses.direction[rows]
    write_points(file, make_points([FREE] * len(rows), names, [1] * len(rows), q, nowhere, sides))


def plan_json(plan: Plan, tasks: Tasks) -> dict[str, object]:
    """The plan for programs; SI units, way-points by their number in the file."""
    chosen = plan.chosen
    content: dict[str, object] = {
        "as_given": entries(plan.plain.cost, *COSTS),
        "as_planned": entries(chosen.cost, *COSTS),
        "choices": [{"choice": name, "rms_m": error_m} for name, error_m in plan.steps],
        "shift_m": chosen.shift_m,
    }
    if isinstance(chosen, WayOfPath):
        content |= {"branch": chosen.plan.branch} | entries(chosen, "lead_in_rad", "is_reversed", "pace")
    else:
        content["stops"] = [_stop(chosen, row) for row in chosen.order]
    if tasks is not None:
        content["tolerance_m"] = tasks[0].tolerance_m
        content["probability"] = {"as_given": tasks[0].probability, "as_planned": tasks[1].probability}
    return content | {"in_words": sentences(plan, tasks)}


def _stop(way: WayOfStops, row: int) -> dict[str, object]:
    return {
        "waypoint": row + 1,
        "q_rad": way.poses.q_rad[row],
        "direction": way.poses.direction[row].astype(int),
        "lead_in_rad": way.lead_in_rad[row] if way.has_lead_in[row] else None,
    }


def _angles(q_rad: Sequence[float]) -> str:
    return " ".join(f"{q:.6f}" for q in q_rad)


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
        as_given, planned = tasks
        yield (
            f"{_mm(as_given.tolerance_m)} is kept with a probability of {100 * as_given.probability:.1f} % as given,"
            f" {100 * planned.probability:.1f} % as planned ({as_given.draws} draws)."
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
    )
    part_m, why = max(causes)
    return f"Most of what is left, {_mm(part_m)}, is {why}."


def _about_table(chosen: WayOfPath | WayOfStops) -> Iterator[str]:
    table = chosen.arm.table
    if chosen.shift_m != NOWHERE and table is not None and table.known_pose and table.origin_m is not None:
        x, y, z = table.origin_m
        yield f"If the work is on the table, move it too: origin_m = [{x:.4f}, {y:.4f}, {z:.4f}] in [table] of arm.toml."


def _mm(length_m: float) -> str:
    return f"{1e3 * length_m:.3g} mm"
