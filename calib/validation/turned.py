"""Measured orientations against those of two models of an arm, from the encoders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arm_problem.frames import mean_rotation
from calib.arm_problem.joint_effects import known_corrections
from calib.arrays import Array, frozen, norms
from calib.points.points import Points
from calib.validation.verify_recorded import measuring_frame
from control.kinematics.kinematics import Kinematics
from control.kinematics.rotation import logarithms, matrices
from control.model.arm import Arm


@dataclass(frozen=True, slots=True)
class TurnComparison:
    """Angles (r,) [rad] between measured and modelled orientation, before and after calibration.

    How the target sits on the last link is fitted for each model: only what varies with the pose counts.
    """

    before_rad: Array
    after_rad: Array

    def in_words(self) -> str:
        """A sentence for the operator."""
        before, after = (1e3 * float(np.mean(part)) for part in (self.before_rad, self.after_rad))
        return (
            f"Orientations of {len(self.after_rad)} poses: mean error {before:.2f} mrad before, {after:.2f} mrad after, with"
            " the target where it fits each model best."
        )

    def as_dict(self) -> dict[str, object]:
        """For verify.json."""
        return {
            "points": len(self.after_rad),
            "before": _figures(self.before_rad),
            "after": _figures(self.after_rad),
        }


def compare_turns(nominal: Arm, calibrated: Arm, points: Points) -> TurnComparison | None:
    """The comparison at all poses with a measured orientation; None with fewer than three."""
    rows = np.flatnonzero(np.isfinite(points.orientation).all(axis=1))
    if len(rows) < 3:
        return None
    some = points.chosen(rows)
    return TurnComparison(*(frozen(_angles_rad(arm, some)) for arm in (nominal, calibrated)))


def _angles_rad(arm: Arm, points: Points) -> Array:
    q = points.q_rad + known_corrections(arm, points)
    model = Kinematics(arm).link_transforms(q)[:, -1, :3, :3]
    measured = measuring_frame(arm, points).rotation @ matrices(points.orientation)
    target = mean_rotation(np.swapaxes(model, 1, 2) @ measured)
    return norms(logarithms(measured @ np.swapaxes(model @ target, 1, 2)))


def _figures(angles_rad: Array) -> dict[str, float]:
    return {
        "mean_rad": float(np.mean(angles_rad)),
        "rms_rad": float(np.sqrt(np.mean(angles_rad**2))),
        "max_rad": float(np.max(angles_rad)),
    }
