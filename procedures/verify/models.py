"""The nominal and the calibrated model of one arm, and how each is used with one runtime."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from calib.arm_problem.assembly import base_frame_of
from calib.arm_problem.frames import Frame
from control.dynamics.joint_side import SIDE_EFFECTS
from control.errors import ArmError
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Vector3
from control.model.description import arm_names, load_arm
from control.model.fingerprint import fingerprint
from control.server.channel import Message


class Model:
    """One model of the arm, and what is needed to move the tip in the frame of table and camera."""

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        self.frame: Frame = base_frame_of(arm)

    @cached_property
    def kinematics(self) -> ForwardKinematics:
        """Forward kinematics of this model."""
        return self.inverse.kinematics

    @cached_property
    def inverse(self) -> InverseKinematics:
        """Inverse kinematics of this model."""
        return InverseKinematics(self.arm)

    @cached_property
    def gears(self) -> frozenset[tuple[object, ...]]:
        """Effects of the model between joints and encoders."""
        return frozenset(
            (e.effect, e.joint, *sorted(e.parameters.items()))
            for e in self.arm.effects
            if e.effect in SIDE_EFFECTS
        )

    def has_gears_of(self, runtime_model: "Model") -> bool:
        """Whether a runtime with the other model corrects exactly this model's gear effects."""
        return self.gears == runtime_model.gears

    def in_base(self, point_m: Sequence[float]) -> Vector3:
        """A point of the frame of table and camera, in the model's base frame."""
        x, y, z = self.frame.to_base(np.array([point_m]))[0].tolist()
        return x, y, z

    def tips(self, q_rad: np.ndarray) -> np.ndarray:
        """Tips (m, 3) of poses (m, n), in the frame of table and camera."""
        return self.seen(self.kinematics.tips(q_rad))

    def seen(self, base_m: np.ndarray) -> np.ndarray:
        """Points (m, 3) of the model's base frame, in the frame of table and camera."""
        return np.asarray((base_m - self.frame.origin_m) @ self.frame.rotation)


@dataclass(frozen=True, slots=True)
class ModelPair:
    """The two models that are compared."""

    nominal: Model
    calibrated: Model


def nominal_of(calibrated: Arm, against: str | None) -> Arm:
    """The arm that a calibrated one is compared with: the given one, or the one that it was calibrated from.

    ArmError if its file does not name one, the file is missing, or the two have other joints. Fixed rows and the convention may
    differ: each model predicts by its own.
    """
    nominal = load_arm(against or _source_of(calibrated))
    if nominal.joint_count != calibrated.joint_count:
        shapes = [
            f"{arm.joint_count} joints, {len(arm.links)} links and {arm.dh_convention} DH"
            for arm in (nominal, calibrated)
        ]
        raise ArmError(f"{calibrated.path} has {shapes[1]}, {nominal.path} {shapes[0]}: not the same arm")
    return nominal


def _source_of(calibrated: Arm) -> str:
    if calibrated.calibration is None:
        raise ArmError(
            f"{calibrated.path}: has no [calibration], so its nominal arm is unknown; give it with --against"
        )
    source = calibrated.calibration.source
    beside = (calibrated.path or Path()).parent / source
    for candidate in (beside, Path(source)):
        if candidate.is_file() and (calibrated.path is None or not candidate.samefile(calibrated.path)):
            return str(candidate)
    if Path(source).stem in arm_names():
        return Path(source).stem
    raise ArmError(
        f"{calibrated.path}: its nominal arm {source} was found neither beside it nor in this folder; give it with"
        " --against"
    )


def active_model(status: Message, pair: ModelPair) -> Model:
    """The model of the pair that the runtime uses. ArmError if neither."""
    if not status["is_homed"] or status["tip_m"] is None:
        raise ArmError("the arm is not homed, so its angles are unknown: run `armwright home`")
    for model in (pair.calibrated, pair.nominal):
        if fingerprint(model.arm) == status["fingerprint"]:
            return model
    raise ArmError(
        f"the runtime uses another arm than {pair.calibrated.arm.path} or {pair.nominal.arm.path}, so its tip"
        " positions would differ; start `armwright serve` with one of the two"
    )
