"""Averaging at rest, for calibration points.

A request starts it, every cycle adds to it, and the result is ready after its duration. Camera frames are averaged too.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from control.hardware.measurement import Measurement, RunningMean


@dataclass(frozen=True, slots=True)
class Average:
    """Means at rest over `duration_s`; joint angles in rad, tip in the base frame in m."""

    duration_s: float
    samples: int
    q_rad: tuple[float, ...]
    q_std_rad: tuple[float, ...]
    current_A: tuple[float, ...]
    direction: tuple[int, ...]
    camera_frames: int
    tip_m: tuple[float, float, float] | None
    tip_std_m: tuple[float, float, float] | None
    moved_rad: float
    t_s: float


class Averaging:
    """Averages angles, currents and camera frames from `start_s` for `duration_s`."""

    def __init__(self, start_s: float, duration_s: float) -> None:
        self.result: Average | None = None
        self._start_s = start_s
        self._duration_s = duration_s
        self._q_rad = RunningMean()
        self._current_A = RunningMean()
        self._tip_m = RunningMean()

    def add(
        self,
        now_s: float,
        measured: Measurement,
        current_A: Sequence[float],
        tip_m: tuple[float, float, float] | None,
    ) -> None:
        """Add one cycle; sets `result` after the last one."""
        if self.result is not None:
            return
        self._q_rad.add(measured.q_rad)
        self._current_A.add(current_A)
        if tip_m is not None:
            self._tip_m.add(tip_m)
        if now_s - self._start_s >= self._duration_s:
            self.result = self._finish(measured.direction)

    def _finish(self, direction: Sequence[int]) -> Average:
        frames = self._tip_m.count
        return Average(
            duration_s=self._duration_s,
            samples=self._q_rad.count,
            q_rad=self._q_rad.mean(),
            q_std_rad=self._q_rad.std(),
            current_A=self._current_A.mean(),
            direction=tuple(direction),
            camera_frames=frames,
            tip_m=_vector(self._tip_m.mean()) if frames else None,
            tip_std_m=_vector(self._tip_m.std()) if frames else None,
            moved_rad=self._q_rad.spread(),
            t_s=self._start_s,
        )


def _vector(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z
