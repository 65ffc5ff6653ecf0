"""Averaging at rest, for calibration points.

A request starts it, every cycle adds to it, and the result is ready after its duration. Camera frames are averaged too.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from control.hardware.measurement import Measurement, RunningMean

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class MeanPose:
    """Mean pose of what the camera follows, in the camera's own frame, or in the base frame if its place there is known."""

    frames: int
    position_m: Vector
    std_m: Vector
    orientation: Quaternion | None  # w, x, y, z; None from a camera that measures positions


@dataclass(frozen=True, slots=True)
class Average:
    """Means at rest over `duration_s`; joint angles in rad, tip in the base frame in m.

    count_rad: what one count of each joint's encoder is at the joint.
    """

    duration_s: float
    samples: int
    q_rad: tuple[float, ...]
    q_std_rad: tuple[float, ...]
    current_A: tuple[float, ...]
    direction: tuple[int, ...]
    camera_frames: int
    tip_m: tuple[float, float, float] | None
    tip_std_m: tuple[float, float, float] | None
    count_rad: tuple[float, ...]
    t_s: float
    target: MeanPose | None = None


class Averaging:
    """Averages angles, currents and camera frames from `start_s` for `duration_s`."""

    def __init__(self, start_s: float, duration_s: float) -> None:
        self.result: Average | None = None
        self._start_s = start_s
        self._duration_s = duration_s
        self._q_rad = RunningMean()
        self._current_A = RunningMean()
        self._tip_m, self._orientation = RunningMean(), RunningMean()
        self._is_in_base = True

    def add(
        self,
        now_s: float,
        measured: Measurement,
        current_A: Sequence[float],
        seen: tuple[Vector, Quaternion | None] | None,
        is_in_base: bool = True,
    ) -> None:
        """Add one cycle, and a new sight of the tip if there is one; sets `result` after the last cycle."""
        if self.result is not None:
            return
        self._q_rad.add(measured.q_rad)
        self._current_A.add(current_A)
        if seen is not None:
            self._see(*seen)
            self._is_in_base = is_in_base
        if now_s - self._start_s >= self._duration_s:
            self.result = self._finish(measured.direction, measured.count_rad)

    def _see(self, tip_m: Vector, orientation: Quaternion | None) -> None:
        self._tip_m.add(tip_m)
        if orientation is None:
            return
        # q and -q are one orientation: all are taken on the side of the first
        first = self._orientation.first or orientation
        sign = math.copysign(1.0, sum(a * b for a, b in zip(first, orientation, strict=True)))
        self._orientation.add([sign * value for value in orientation])

    def _target(self) -> MeanPose | None:
        if not self._tip_m.count:
            return None
        orientation: Quaternion | None = None
        if self._orientation.count:
            mean = self._orientation.mean()
            w, x, y, z = (value / math.hypot(*mean) for value in mean)
            orientation = (w, x, y, z)
        return MeanPose(self._tip_m.count, _vector(self._tip_m.mean()), _vector(self._tip_m.std()), orientation)

    def _finish(self, direction: Sequence[int], count_rad: tuple[float, ...]) -> Average:
        target = self._target()
        in_base = target if self._is_in_base else None
        return Average(
            duration_s=self._duration_s,
            samples=self._q_rad.count,
            q_rad=self._q_rad.mean(),
            q_std_rad=self._q_rad.std(),
            current_A=self._current_A.mean(),
            direction=tuple(direction),
            camera_frames=in_base.frames if in_base is not None else 0,
            tip_m=in_base.position_m if in_base is not None else None,
            tip_std_m=in_base.std_m if in_base is not None else None,
            count_rad=count_rad,
            t_s=self._start_s,
            target=target,
        )


def _vector(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z
