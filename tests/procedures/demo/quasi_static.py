"""A bench whose arm has no dynamics: it stands at once where it is told, on the flank that gravity and friction say."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from control.dynamics.dynamics import Dynamics
from control.hardware.measurement import Average, MeanPose
from control.kinematics.inverse import InverseKinematics
from control.model.arm import Arm

FRICTION_Nm = np.array([1.3, 1.5, 0.9])
LINK_SHARE = 0.5
ENCODER_NOISE_rad, CURRENT_NOISE_A = 1e-5, 0.005


class QuasiStaticBench:
    """`procedures.mock.MockBench`: DH deviations and play are hidden, nothing takes time."""

    speed = 1.0

    def __init__(
        self, arm: Arm, deviation: np.ndarray, width_rad: Sequence[float], camera_m: float = 1.4e-4, seed: int = 0
    ) -> None:
        self._true_dh, self._width_rad = arm.dh + deviation, np.array(width_rad)
        self._model, self._camera_m = ArmModel(arm), camera_m
        self._random = np.random.default_rng(seed)
        self._true_inverse = InverseKinematics(arm.with_dh(self._true_dh))
        self._torque = Dynamics(arm)
        self._per_A = np.array([d.gear_ratio * d.torque_constant_Nm_A for d in arm.drives])
        self._motor_rad = np.array(arm.rest.q_rad if arm.rest is not None else np.zeros(arm.joint_count))
        self._joint_rad = self._motor_rad.copy()
        self._last = np.ones(arm.joint_count)
        self._held_Nm = np.zeros(arm.joint_count)
        self._t_s, self.mode, self.moves = 0.0, "OFF", 0
        self.rig: Any = SimpleNamespace(hand=self)
        self.state = "away"

    # Bench
    def start(self, arm: Arm) -> Any:
        return self

    def wait(self, duration_s: float) -> None:
        self._t_s += duration_s

    def stop(self) -> Path:
        self.mode = "OFF"
        return Path("none")

    def close(self) -> None:
        pass

    # ArmClient
    def enable(self) -> None:
        self.mode = "HOLDING"

    home: Callable[[], None] = enable
    hold: Callable[[], None] = enable

    def guide(self) -> None:
        self.mode = "GUIDED"

    def status(self) -> dict[str, Any]:
        return {
            "t_s": self._t_s,
            "q_rad": tuple(self._motor_rad.tolist()),
            "mode": self.mode,
            "temperature_C": [None] * len(self._last),
            "camera_problem": "",
        }

    def move_joints(self, q_rad: Sequence[float], speed: float = 1.0, as_encoders: bool = False) -> None:
        """The motors go there; each link follows on the flank of gravity torque and its share of friction.

        Its runtime knows no gears, so that joint and encoder angles are the same to it.
        """
        assert self.mode == "HOLDING"
        self.moves += 1
        target = np.array(q_rad)
        self._last = np.where(np.abs(target - self._motor_rad) > 1e-6, np.sign(target - self._motor_rad), self._last)
        self._motor_rad = target
        gravity = np.array(self._torque.gravity(target.tolist()))
        flank = np.sign(gravity + LINK_SHARE * FRICTION_Nm * self._last)
        self._joint_rad = target - 0.5 * self._width_rad * flank
        self._held_Nm = FRICTION_Nm * self._last

    def average(self, duration_s: float) -> Average:
        self._t_s += duration_s
        noise = self._random.normal
        gravity = np.array(self._torque.gravity(self._motor_rad.tolist()))
        current = (gravity + self._held_Nm) / self._per_A + noise(0.0, CURRENT_NOISE_A, len(gravity))
        q = self._motor_rad + noise(0.0, ENCODER_NOISE_rad, len(gravity))
        tip = self._tip_m() + noise(0.0, self._camera_m / np.sqrt(100.0 * duration_s), 3)
        seen = MeanPose(10, (float(tip[0]), float(tip[1]), float(tip[2])), (self._camera_m,) * 3, None)
        return Average(
            duration_s,
            50,
            tuple(q.tolist()),
            (ENCODER_NOISE_rad,) * len(gravity),
            tuple(current.tolist()),
            tuple(int(d) for d in self._last),
            seen.frames,
            seen.position_m,
            seen.std_m,
            (),
            self._t_s,
            seen,
        )

    # MockHand
    def seat(self, point_m: Sequence[float]) -> float:
        """The hand puts the tip there; links push their motors, and gravity's feed-forward takes joint 2 across its play."""
        joint = np.array(self._true_inverse.nearest(tuple(point_m), self._joint_rad.tolist()))
        self._last = np.where(joint >= self._joint_rad, 1.0, -1.0)
        gravity = np.array(self._torque.gravity(joint.tolist()))
        pushed = np.abs(gravity) > (1.0 - LINK_SHARE) * FRICTION_Nm
        flank = np.where(pushed, np.sign(gravity), -0.8 * self._last)
        self._joint_rad, self._motor_rad = joint, joint + 0.5 * self._width_rad * flank
        self._held_Nm = np.zeros(len(joint))
        self.state = "holding"
        return 0.3

    def let_go(self) -> None:
        self.state = "away"

    def residual_m(self) -> float:
        return 0.0

    def _tip_m(self) -> np.ndarray:
        return np.asarray(self._model.tips(self._true_dh, self._joint_rad[None])[0])
