"""plan.csv for the session, plan.json for other programs."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from calib.design.information import Uncertainty
from calib.design.plan import Plan
from calib.design.words import in_words
from calib.points.points import make_points
from calib.points.writer import replace_file, write_points

FORMAT = "plan/1"


def write_plan(folder: Path, plan: Plan, arm: str) -> tuple[Path, Path]:
    """Write plan.csv (setup, point, repeat, q1_rad ... in visiting order) and plan.json; returns their paths."""
    table, text = folder / "plan.csv", folder / "plan.json"
    points = plan.points
    nowhere = np.full((len(points), 3), np.nan)  # tips are yet to be measured
    write_points(table, make_points(points.setup, points.point, points.repeat, points.q_rad, nowhere))
    replace_file(text, (json.dumps(plan_json(plan, arm), indent=2, allow_nan=False) + "\n").encode())
    return table, text


def plan_json(plan: Plan, arm: str) -> dict[str, object]:
    """The plan for other programs: SI units; poses in order of value, `visit` is the visiting order."""
    return {
        "format": FORMAT,
        "arm": arm,
        "criterion": plan.criterion,
        "noise_m": plan.noise_m,
        "candidates": dict(plan.candidates),
        "combinations": plan.combinations_count,
        "is_tied_to_base": plan.is_tied,
        "before": _state(plan.before),
        "after": _state(plan.after),
        "points": [
            {
                "setup": pose.setup,
                "point": pose.point,
                "repeat": pose.repeat,
                "q_rad": list(pose.q_rad),
                "visit": pose.visit,
                "log_det_gain": pose.gain,
                "after": _state(pose.after),
            }
            for pose in plan.poses
        ],
        "alternatives": [
            {"setup": one.setup, "points": one.count, "log_det_gain": one.gain, "after": _state(one.after)}
            for one in plan.alternatives
        ],
        "not_clear_between": [list(pair) for pair in plan.blocked],
        "in_words": list(in_words(plan)),
    }


def _state(state: Uncertainty) -> dict[str, object]:
    return {
        "points": state.points_count,
        "log_det": state.log_det,
        "observability": state.indices.as_dict(),
        "rank": state.rank,
        "tip_m": state.tip_m,
        "tip_worst_m": state.tip_worst_m,
        "least_known": {
            "name": state.least_known,
            "sd": state.least_known_sd if math.isfinite(state.least_known_sd) else None,
            "unit": state.least_known_unit,
        },
    }
