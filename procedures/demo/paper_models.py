"""The identified models of the replay, and the encoder angles that move their tips to targets."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.joint_effects import known_corrections, unclear_flanks, unphysical
from calib.arrays import Array
from calib.calibration.outcome import calibrated_arm
from calib.identify.identification import Identification, identify
from calib.points.points import Points, make_points
from control.dynamics.static_pose import friction_Nm, gravity_Nm, resting, torque_per_A
from control.kinematics.inverse import InverseKinematics
from control.model.arm import Arm, Effect
from procedures.demo.paper_moves import GentlePose
from procedures.demo.paper_poses import SETUPS, Target

TILTS, FREE, BACKLASH = "all tilts", "tilts and free", "with backlash"


@dataclass(frozen=True, slots=True)
class PaperModel:
    """An identification: the resulting arm, the points used, and remarks."""

    name: str
    what: str
    arm: Arm
    points_count: int
    found: Identification
    remarks: tuple[str, ...]

    @property
    def backlash(self) -> tuple[Effect, ...]:
        """Backlash of the model."""
        return tuple(effect for effect in self.arm.effects if effect.effect == "backlash")


def models_of(arm: Arm, points: Points) -> tuple[PaperModel, ...]:
    """The identifications: each tilt alone as the authors did, all tilts, free poses as well, backlash in the model."""
    tilts = [k for k, setup in enumerate(points.setup) if setup in SETUPS]
    alone = [
        _identified(arm, points, [k for k in tilts if points.setup[k] == s], s, f"the {s} board alone")
        for s in SETUPS
    ]
    everywhere = range(len(points))
    return (
        *alone,
        _identified(arm, points, tilts, TILTS, "the three tilts together"),
        _identified(arm, points, everywhere, FREE, "the tilts and free poses, geometry alone"),
        _identified(
            arm, points, everywhere, BACKLASH, "the tilts and free poses, backlash in the model", True
        ),
    )


def _identified(
    arm: Arm, points: Points, rows: Sequence[int], name: str, what: str, has_backlash: bool = False
) -> PaperModel:
    """Identify by the sum of distances within 5 mm and 2 degrees, as in the paper."""
    used = points.chosen(rows)
    wanted = [f"backlash:{joint}" for joint in range(1, arm.joint_count + 1)] if has_backlash else []
    found = identify(problem_of(arm, used, Choice(effects=tuple(wanted))))
    notes = (*unclear_flanks(arm, used, wanted), *unphysical(found.solution.corrections))
    return PaperModel(name, what, calibrated_arm(arm, found), len(used), found, (*found.in_words(), *notes))


def table_says(arm: Arm, points: Points) -> tuple[str, ...]:
    """Remarks on backlash from the tilts alone: flanks that never change."""
    tilts = points.chosen([k for k, setup in enumerate(points.setup) if setup in SETUPS])
    wanted = [f"backlash:{joint}" for joint in range(1, arm.joint_count + 1)]
    return unclear_flanks(arm, tilts, wanted)


def with_friction(model: PaperModel, arm: Arm, points: Points) -> Arm:
    """The model's arm with the dry friction shown by its motors, from which flanks are predicted before motion."""
    gravity = gravity_Nm(arm, points.q_rad)
    level, _ = friction_Nm(arm, points.current_A * torque_per_A(arm) - gravity, gravity)
    shown = tuple(
        Effect("coulomb_friction", joint, {"torque_Nm": float(torque)})
        for joint, torque in enumerate(level, 1)
    )
    return dataclasses.replace(model.arm, effects=(*model.arm.effects, *shown))


def commands(arm: Arm, targets: Sequence[Target], start_rad: Sequence[float]) -> tuple[GentlePose, ...]:
    """Encoder angles for tips, by the arm's own model; each joint comes from where it was.

    If the model has backlash, the angles are corrected for the predicted flank; a joint whose flank is
    ambiguous is approached from the side where gravity and friction agree.
    """
    inverse, way = InverseKinematics(arm), [np.array(start_rad)]
    for _, _, tip_m in targets:
        way.append(np.array(inverse.nearest(tip_m, way[-1].tolist())))
    joint_rad = np.array(way[1:])
    direction = np.where(np.diff(way, axis=0) >= 0.0, 1.0, -1.0)
    if any(effect.effect == "backlash" for effect in arm.effects):
        direction = _clear(arm, joint_rad, direction)
    encoder_rad = joint_rad - _ahead(arm, joint_rad, direction)
    return tuple(
        GentlePose(setup, point, tuple(q.tolist()), tuple(int(d) for d in signs))
        for (setup, point, _), q, signs in zip(targets, encoder_rad, direction, strict=True)
    )


def _clear(arm: Arm, joint_rad: Array, direction: Array) -> Array:
    """Directions (m, n) with an unambiguous flank."""
    rest = resting(arm, joint_rad, direction)
    with_gravity = np.where(rest.gravity_Nm >= 0.0, 1.0, -1.0)
    return np.where(rest.flank == 0.0, with_gravity, direction)


def _ahead(arm: Arm, joint_rad: Array, direction: Array) -> Array:
    """Joint minus encoder angles (m, n) by the arm's static effects."""
    m = len(joint_rad)
    there = make_points(
        [""] * m, [str(k) for k in range(m)], [1] * m, joint_rad, np.full((m, 3), np.nan), direction
    )
    return known_corrections(arm, there)
