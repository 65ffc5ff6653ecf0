"""Checks new records against earlier ones, to detect a badly seated tip immediately.

An uncalibrated arm is centimetres off, but systematically: its DH parameters deviate by some millimetres and degrees.
From earlier records, the most likely DH deviations are estimated (Gauss-Newton, a normal prior of half the usual bounds),
and from them the new record and its covariance are predicted. The result is the distance from it in standard deviations
(the normalised innovation of a Kalman filter).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arm_problem.assembly import base_frame_of
from calib.arm_problem.observations import rotation_of
from calib.arrays import Array, norms
from calib.boards import BoardPose, best_motion, pose_jacobian
from control.kinematics.chain import tips_and_dh_jacobian
from control.model.arm import Arm

SUSPECT = 6.0  # standard deviations; for three normal errors beyond it is one record in ten million
FEWEST_BEFORE = 2  # records needed for a verdict, on a board with a known pose
FEWEST_ON_UNKNOWN = 4  # its pose needs three
PRIOR_LENGTH_m, PRIOR_ANGLE_rad = 0.0025, 0.0175  # half of SpringerPlus 5:1771, eq. (4)
PRIOR_POSE_m, PRIOR_POSE_rad = 1.0, 1.0  # prior of an unknown board: anywhere
NOISE_m, NOISE_WEIGHT = 7e-4, 6.0  # prior noise of a record; counts as this many degrees of freedom
FLOOR_m = 5e-5  # smallest noise of a seated tip
STEPS = 3
CLIP = 3.0  # robust: residuals beyond this many times the noise are down-weighted


@dataclass(frozen=True, slots=True)
class RecordVerdict:
    """Verdict on a record. error_m: tip minus model, (3,) at nominal; NaN if the board's pose is unknown.

    off_sd: distance from the prediction of earlier records, in standard deviations; off_m: the same in m. Both NaN
    if there are too few of them.
    """

    error_m: Array
    off_m: float = float("nan")
    off_sd: float = float("nan")

    @classmethod
    def of(cls, error_m: Array, innovation_m: Array, spread_m2: Array) -> RecordVerdict:
        """By a prediction: the innovation (3,) and its covariance (3, 3)."""
        off_sd = float(np.sqrt(innovation_m @ np.linalg.solve(spread_m2, innovation_m)))
        return cls(error_m, float(np.linalg.norm(innovation_m)), off_sd)

    @property
    def is_suspect(self) -> bool:
        """Whether the tip was probably not in its cavity."""
        return self.off_sd > SUSPECT


@dataclass(frozen=True, slots=True)
class TipObservation:
    """One record: the tip by table or camera, or in the board's frame if its pose is unknown."""

    setup: str
    q_rad: tuple[float, ...]
    place_m: tuple[float, float, float]
    is_on_unknown_board: bool = False


class ResidualWatch:
    """Stores observations and checks new ones."""

    def __init__(self, arm: Arm) -> None:
        self._dh, self._base = np.array(arm.dh), base_frame_of(arm)
        self._model = (arm.joints, arm.dh_convention, arm.tool.position_m)
        prior = [PRIOR_LENGTH_m, PRIOR_ANGLE_rad, PRIOR_LENGTH_m, PRIOR_ANGLE_rad]
        self._prior = np.array(prior * len(self._dh))
        self._seen: dict[object, TipObservation] = {}

    def add(self, key: object, observation: TipObservation) -> None:
        """Add an observation."""
        self._seen[key] = observation

    def forget(self, key: object) -> None:
        """Remove an observation."""
        self._seen.pop(key, None)

    def judge(self, new: TipObservation) -> RecordVerdict:
        """Compare a record with earlier ones."""
        before = [record for record in self._seen.values() if not record.is_on_unknown_board or record.setup == new.setup]
        error_m = self._error_m(new)
        on_its_board = sum(record.setup == new.setup for record in before)
        if len(before) < FEWEST_BEFORE or (new.is_on_unknown_board and on_its_board < FEWEST_ON_UNKNOWN):
            return RecordVerdict(error_m)
        return RecordVerdict.of(error_m, *self._predicted(before, new))

    def _error_m(self, new: TipObservation) -> Array:
        if new.is_on_unknown_board:
            return np.full(3, np.nan)
        tip_m = self._base.to_base(np.array([new.place_m]))[0]
        return np.asarray(tip_m - self._tips(self._dh, [new])[0][0])

    def _predicted(self, before: list[TipObservation], new: TipObservation) -> tuple[Array, Array]:
        """The new record's innovation (3,) [m] and its covariance (3, 3) [m2]."""
        pose = _fitted_pose(new.setup, before, self._tips(self._dh, before)[0])
        scales = np.concatenate((self._prior, np.repeat([PRIOR_POSE_m, PRIOR_POSE_rad], 3)))
        x, noise_m = np.zeros(len(scales)), NOISE_m
        for _ in range(STEPS):
            residual, slopes = self._linearised(before, pose, scales, x)
            weights = weights_of(residual, noise_m) / noise_m**2
            information = np.einsum("m,mik,mil->kl", weights, slopes, slopes) + np.eye(len(x))
            aim = residual + slopes @ x
            x = np.linalg.solve(information, np.einsum("m,mik,mi->k", weights, slopes, aim))
            pose, x = _moved(pose, scales, x)
            left, _ = self._linearised(before, pose, scales, x)
            noise_m = _noise_m(left, len(x) - float(np.trace(np.linalg.inv(information))))
        innovation, slopes = self._linearised([new], pose, scales, x)
        covariance = slopes[0] @ np.linalg.solve(information, slopes[0].T)
        return innovation[0], covariance + noise_m**2 * np.eye(3)

    def _linearised(self, observations: list[TipObservation], pose: BoardPose, scales: Array, x: Array) -> tuple[Array, Array]:
        """Residuals (m, 3), tip minus model, and minus their derivative by each unknown, (m, 3, unknowns)."""
        dh = self._dh + (x * scales)[: self._dh.size].reshape(self._dh.shape)
        tips, by_dh = self._tips(dh, observations)
        places = np.array([one.place_m for one in observations])
        is_unknown = np.array([one.is_on_unknown_board for one in observations])
        tip_m = np.where(is_unknown[:, None], pose.to_base(places), self._base.to_base(places))
        by_pose = -pose_jacobian(places @ pose.rotation.T) * is_unknown[:, None, None]
        return tip_m - tips, np.concatenate((by_dh, by_pose), axis=2) * scales

    def _tips(self, dh: Array, observations: list[TipObservation]) -> tuple[Array, Array]:
        return tips_and_dh_jacobian(dh, np.array([one.q_rad for one in observations]), *self._model)


def _fitted_pose(setup: str, observations: list[TipObservation], tips_m: Array) -> BoardPose:
    """The pose of a setup's unknown board fitted to the tips; arbitrary if it is known."""
    rows = [k for k, one in enumerate(observations) if one.is_on_unknown_board and one.setup == setup]
    if not rows:
        return BoardPose(np.eye(3), np.zeros(3))
    motion = best_motion(np.array([observations[k].place_m for k in rows]), tips_m[rows])
    return BoardPose(motion.rotation, motion.shift_m)


def _moved(pose: BoardPose, scales: Array, x: Array) -> tuple[BoardPose, Array]:
    """The pose with its part of x applied, and x without it, so that rotations stay small."""
    shift, turn = x[-6:-3] * scales[-6:-3], x[-3:] * scales[-3:]
    remaining = np.array(x)
    remaining[-6:] = 0.0
    return BoardPose(np.asarray(rotation_of(turn) @ pose.rotation), pose.origin_m + shift), remaining


def weights_of(residual_m: Array, noise_m: float) -> Array:
    """Huber's weights: 1, and less for residuals beyond some times the noise."""
    return np.minimum(1.0, CLIP * noise_m / np.maximum(norms(residual_m), FLOOR_m))


def _noise_m(residual_m: Array, used: float) -> float:
    """Robust standard deviation per axis, including the prior. `used`: fitted degrees of freedom."""
    freedom = max(0.0, residual_m.size - used)
    median_m = float(np.median(norms(residual_m))) / 1.538  # of the norm of three standard normals
    found_m2 = median_m**2 * residual_m.size / max(1.0, freedom)
    return max(FLOOR_m, float(np.sqrt((NOISE_WEIGHT * NOISE_m**2 + freedom * found_m2) / (NOISE_WEIGHT + freedom))))
