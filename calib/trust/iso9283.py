"""ISO 9283's pose accuracy and repeatability: predicted for the poses of a recorded programme, beside the measured ones.

Each draw is an arm that the points allow and one run of the programme: its errors, and the scatter of every visit, that of the
measurement included. AP_p and RP_l of a draw are as the standard has them (ISO 9283:1998, 7.2), for as many visits as recorded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from calib.arm_problem.link_bending import known_bending
from calib.arrays import Array, norms
from calib.iso9283.criteria import pose
from calib.iso9283.evaluate_poses import is_pose_setup
from calib.iso9283.recorded import pose_groups
from calib.points.points import Points
from calib.trust.discrepancy import Conditions
from calib.trust.prediction import Predictor
from calib.validation.statistics import IntervalFigure
from control.model.arm import Arm

DRAWS: Final = 400


@dataclass(frozen=True, slots=True)
class PoseFigures:
    """A pose: AP_p and RP_l [m] as predicted (median and 95 % interval) and as measured; None without enough visits."""

    where: str
    visits: int
    accuracy_m: IntervalFigure
    repeatability_m: IntervalFigure | None
    measured_accuracy_m: float | None
    measured_repeatability_m: float | None


def pose_figures(
    predictor: Predictor, arm: Arm, points: Points, path: Path, seed: int = 0
) -> tuple[PoseFigures, ...]:
    """Of every pose of the plain programmes in points.csv of `armwright iso9283`."""
    groups, _ = pose_groups(points, arm, path)
    keys = list(zip(points.setup, points.point, strict=True))
    found = []
    for group in groups:
        if not is_pose_setup(group.setup):
            continue
        rows = [k for k, key in enumerate(keys) if key == (group.setup, group.point)]
        some = points.chosen(rows)
        bent = known_bending(arm, some.q_rad, some.payload_kg)
        wanted = group.commanded_m - (0.0 if bent is None else bent.shift)
        off = _drawn(predictor, Conditions.recorded(arm, some), wanted, seed)
        attained, n = group.attained_m, len(group.attained_m)
        found.append(
            PoseFigures(
                f"{group.setup} {group.point}",
                len(rows),
                _figure(norms(off.mean(axis=1))),
                _figure(_repeatability(off)) if len(rows) > 1 else None,
                pose.pose_accuracy(group.commanded_m, attained).total_m if n else None,
                pose.pose_repeatability(attained).total_m if n > 1 else None,
            )
        )
    return tuple(found)


def _drawn(predictor: Predictor, at: Conditions, commanded_m: Array, seed: int) -> Array:
    """Attained minus commanded position (3,) or (m, 3) of each draw and visit, (DRAWS, m, 3)."""
    error, columns, posterior = predictor.at(at), predictor.columns(at), predictor.posterior
    drawn, rng = posterior.draws(DRAWS, seed), np.random.default_rng(seed + 1)
    same = (drawn - posterior.mean) @ columns.reshape(-1, columns.shape[2]).T
    measuring_m2 = max(0.0, posterior.noise_m**2 - predictor.repeat_m**2)
    scatter = np.linalg.cholesky(predictor.seated_m2(at) + (measuring_m2 + 1e-18) * np.eye(3))
    normal = rng.standard_normal((DRAWS, len(at), 3))
    usual = error.tip_m + error.expected_m - commanded_m
    play = predictor.drawn_play_m(at, drawn, rng)
    return np.asarray(usual + same.reshape(DRAWS, -1, 3) + play + np.einsum("mij,dmj->dmi", scatter, normal))


def _repeatability(off: Array) -> Array:
    """RP_l of each draw (d,)."""
    lengths = np.linalg.norm(off - off.mean(axis=1, keepdims=True), axis=2)
    return np.asarray(lengths.mean(axis=1) + pose.SIGMAS * lengths.std(axis=1, ddof=1))


def _figure(drawn: Array) -> IntervalFigure:
    lower, middle, upper = (float(value) for value in np.quantile(drawn, (0.025, 0.5, 0.975)))
    return IntervalFigure(middle, lower, upper)


def pose_rows(found: Sequence[PoseFigures]) -> list[tuple[str, ...]]:
    """Cells [mm] of a table: pose, visits, AP_p predicted and measured, RP_l predicted and measured."""
    return [
        (
            one.where,
            f"{one.visits}",
            _interval(one.accuracy_m),
            _mm(one.measured_accuracy_m),
            _interval(one.repeatability_m),
            _mm(one.measured_repeatability_m),
        )
        for one in found
    ]


def pose_json(found: Sequence[PoseFigures]) -> list[dict[str, object]]:
    """For programs; SI."""
    return [
        {
            "where": one.where,
            "visits": one.visits,
            **{
                name: {
                    "predicted": predicted and predicted.value,
                    "lower": predicted and predicted.lower,
                    "upper": predicted and predicted.upper,
                    "measured": measured,
                }
                for name, predicted, measured in (
                    ("AP_p_m", one.accuracy_m, one.measured_accuracy_m),
                    ("RP_l_m", one.repeatability_m, one.measured_repeatability_m),
                )
            },
        }
        for one in found
    ]


def _interval(figure: IntervalFigure | None) -> str:
    if figure is None:
        return ""
    return f"{1e3 * figure.value:.3f} ({1e3 * figure.lower:.3f} to {1e3 * figure.upper:.3f})"


def _mm(length_m: float | None) -> str:
    return "" if length_m is None else f"{1e3 * length_m:.3f}"
