"""Columns of laws in poses: terms that move one joint."""

from __future__ import annotations

import numpy as np

from calib.arrays import Array
from calib.gap.effects.pose_scene import PoseScene
from calib.gap.effects.record import EffectRecord, InPoses
from calib.gap.finding import EffectName
from calib.gap.posterior.coefficients import ToParameters, parameters_of
from calib.gap.posterior.term import Term, on_joint
from control.model.effects import moved_joint

NO_TORQUE_Nm = 1e-6  # rounding: below it a joint carries nothing


def in_poses(record: EffectRecord) -> InPoses:
    """What a record has of poses."""
    if record.poses is None:
        raise ValueError(f"{record.effect} is not looked for in poses")
    return record.poses


def term_on_joint(
    scene: PoseScene,
    record: EffectRecord,
    joint: int | None,
    columns: Array,
    *,
    laws: int = 1,
    departures: int = 0,
    variable: str = "",
    variant: float = 0.0,
    is_positive: bool = False,
    parameters: ToParameters | None = None,
    doubt: Array | None = None,
) -> Term:
    """A term on the joint that the effect moves: columns (c, m) per unit of the coefficient, `laws` and `departures` first."""
    size, moved = in_poses(record).size, moved_joint(record.effect, joint) or 1
    slope = size * on_joint(columns, moved - 1, scene.points.joint_count)
    return Term(
        EffectName(record.effect, joint), "", laws, departures, size, slope_rad=slope, variant=variant,
        is_positive=is_positive, parameters=parameters or parameters_of(record.effect), variable=variable, doubt=doubt,
        traits=record.traits,
    )  # fmt: skip


def harmonics(angle: Array, *orders: int) -> list[Array]:
    """Sine and cosine of each order."""
    return [f(order * angle) for order in orders for f in (np.sin, np.cos)]
