"""An arm, a hand, a camera and a geometry for tests of sessions: they write down what they are told, and nothing moves."""

from __future__ import annotations

import math

import numpy as np

from benchmarks.calibration.chains import REFERENCE, REFERENCE_DH, TILTS, board_points
from calib.session import take as sequence
from calib.session.moves import ArmGeometry, RestSample, SeenTip
from control.errors import ArmError
from control.model.description import load_arm

RIGHT = load_arm("right")
GEOMETRY = ArmGeometry(RIGHT)
SEED = np.array([0.0, -1.0, 0.0])


class NumericGeometry(ArmGeometry):
    """The reference arm; the cavity named in `far` is out of reach."""

    def __init__(self, far: tuple[float, float, float] | None = None) -> None:
        super().__init__(RIGHT)
        self._far = far

    def nearest(self, point, q_near):
        if self._far is not None and math.dist(point, self._far) < 1e-9:
            raise ArmError("target is out of reach by 0.012 m")
        return super().nearest(point, q_near)


class ScriptedArm:
    """Writes down what it is told. Encoders tremble for `settle_s` after every motion, then stand."""

    def __init__(self, settle_s: float = 0.2) -> None:
        self.log: list[str] = []
        self.tips: list[np.ndarray] = []
        self.t_s, self.q_rad, self.settle_s, self.moved_s = 0.0, (0.0, -0.3, 0.3), settle_s, -10.0

    def now_s(self) -> float:
        return self.t_s

    def move_to_q(self, q_rad) -> None:
        self.q_rad, self.moved_s = tuple(q_rad), self.t_s + 1.0
        self.t_s += 1.0
        self.log.append("move")
        self.tips.append(REFERENCE.tips(REFERENCE_DH, np.array([q_rad]))[0])

    def creep_to_q(self, q_rad) -> None:
        self.move_to_q(q_rad)
        self.log[-1] = "creep"

    def release(self) -> None:
        self.log.append("release")

    def hold(self) -> None:
        self.log.append("hold")

    def grip(self) -> None:
        self.log.append("grip")

    def seat(self, point_m) -> None:
        self.moved_s = self.t_s
        self.q_rad = GEOMETRY.nearest(point_m, self.q_rad)
        self.log.append("seat")

    def let_go(self) -> None:
        self.log.append("let go")

    def average(self, duration_s: float) -> RestSample:
        self.t_s += duration_s
        shake = 1e-3 * math.cos(300.0 * self.t_s) if self.t_s - self.moved_s < self.settle_s else 0.0
        q_rad = tuple(q + shake for q in self.q_rad)
        return RestSample(q_rad, (1e-5,) * 3, (0.3, 1.5, 0.5), (1, -1, 1), (31.0, 40.5, 29.0))

    def measure(self, duration_s: float):
        """The camera: exactly where the tip is."""
        tip = REFERENCE.tips(REFERENCE_DH, np.array([self.q_rad]))[0]
        return SeenTip(tuple(tip.tolist()), (1e-4, 1e-4, 1e-4))


def board(setup: str, count: int = 4) -> tuple[sequence.BoardPoint, ...]:
    tips = board_points(*TILTS[setup])
    return sequence.board_points(setup, {str(k + 1): tips[k] for k in range(33)})[:count]
