"""Evaluates all fourteen criteria."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from calib.arrays import Array
from calib.iso9283 import evaluate_paths as of_paths
from calib.iso9283 import evaluate_poses as of_poses
from calib.iso9283 import evaluate_settling as of_settling
from calib.iso9283.criteria.checks import above_zero
from calib.iso9283.recorded import PoseGroup, RecordedRun
from calib.iso9283.result import Criterion, Evaluation


def evaluate(
    groups: Sequence[PoseGroup],
    runs: Sequence[RecordedRun] = (),
    others: Mapping[str, Sequence[PoseGroup]] | None = None,
    corners: Sequence[Array] | None = None,
    band_m: float | None = None,
    joint_count: int = 3,
    notes: Sequence[str] = (),
) -> Evaluation:
    """The fourteen criteria, in order; `needs` of each lists missing input.

    others: the same programme by other arms. corners: E1 .. E4 of the rectangle. band_m: the limit band of stabilization,
    overshoot and posing time; the pose repeatability of P1 if absent.
    """
    first = of_poses.pose_criterion(groups)
    bands = _bands(first, band_m)
    stabilization, overshoot, settled = of_settling.settling_criteria(runs, bands)
    along, traces = of_paths.path_criteria(runs)
    return Evaluation(
        (
            first,
            of_poses.direction_criterion(groups),
            of_poses.distance_criterion(groups),
            stabilization,
            overshoot,
            of_poses.drift_criterion(groups),
            of_poses.exchange_criterion(groups, others or {}),
            along,
            of_paths.reorientation_criterion(runs, joint_count),
            of_paths.cornering_criterion(runs, corners),
            of_paths.velocity_criterion(runs),
            of_settling.posing_criterion(runs, bands),
            of_poses.load_criterion(groups),
            of_paths.weaving_criterion(runs),
        ),
        tuple(notes),
        of_poses.clouds(groups),
        tuple(traces),
        tuple(settled),
    )


def _bands(first: Criterion, band_m: float | None) -> of_settling.Bands | None:
    if band_m is not None:
        return of_settling.Bands(above_zero(band_m, "limit band"), "the given limit band")
    found = [f for f in first.figures if f.symbol == "RP_l" and f.where.startswith("P1")]
    return (
        of_settling.Bands(found[0].value, "the repeatability RP_l of P1")
        if found and found[0].value > 0.0
        else None
    )
