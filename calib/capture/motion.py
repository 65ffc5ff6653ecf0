"""The arm's side of an alignment: joint angles over the encoders' time, from one log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.capture.tracks import CaptureError
from calib.gap.log import Log, LoggedRun

STILL_rad_s = 0.005
LEAP_rad, FASTEST_rad_s = 0.02, 50.0  # between samples; beyond both it is no motion
SLOPE_s = 0.05  # over which speeds are taken: a count of an encoder is no speed


@dataclass(frozen=True, slots=True)
class JointMotion:
    """Joint angles q_rad (m, n) at t_s (m,), increasing; speeds (m, n)."""

    t_s: Array
    q_rad: Array
    speed_rad_s: Array

    @classmethod
    def of(cls, log: Log, run: str | None) -> tuple[JointMotion, tuple[str, ...]]:
        """Of one run, or of all if they are on one clock: by t_s, or by the column `cycle` of our own exports.

        What comes before a leap of an angle is left out, and said: homing gives a joint its zero. CaptureError names the runs.
        """
        names = [one.name for one in log.runs]
        runs = [one for one in log.runs if run is None or one.name == run]
        if not runs:
            raise CaptureError(f'{log.sources[0]}: no run "{run}": expected one of {", ".join(names)}')
        t_s = np.concatenate([one.t_s + begin_s for one, begin_s in zip(runs, begins_s(runs), strict=True)])
        if len(t_s) < 10 or not (np.diff(t_s) > 0.0).all():
            raise CaptureError(
                f"{log.sources[0]}: its runs have clocks of their own, or too few samples: give the captured one with --run"
                f" ({', '.join(names)})"
            )
        q_rad = np.concatenate([one.q_rad for one in runs])
        first = after_leaps(t_s, q_rad)
        if len(t_s) - first < 10:
            raise CaptureError(f"{log.sources[0]}: an angle leaps at its end: nothing is left behind it")
        said = (
            (f"the log before {t_s[first]:.2f} s is not used: an angle leaps there, as by homing",)
            if first
            else ()
        )
        return cls(t_s[first:], q_rad[first:], _speeds(t_s[first:], q_rad[first:])), said

    def at(self, t_s: Array) -> tuple[Array, Array]:
        """Joint angles and speeds (k, n) at times within the log, linearly between samples."""
        columns = range(self.q_rad.shape[1])
        q = np.column_stack([np.interp(t_s, self.t_s, self.q_rad[:, j]) for j in columns])
        speed = np.column_stack([np.interp(t_s, self.t_s, self.speed_rad_s[:, j]) for j in columns])
        return q, speed

    def covers(self, t_s: Array) -> Array:
        """(k,), whether times are within the log, and not in a gap of it."""
        after = np.clip(np.searchsorted(self.t_s, t_s), 1, len(self.t_s) - 1)
        gap = self.t_s[after] - self.t_s[after - 1]
        return np.asarray((t_s >= self.t_s[0]) & (t_s <= self.t_s[-1]) & (gap < 2.0 * SLOPE_s), dtype=float)

    def rests(self, least_s: float) -> list[tuple[float, float]]:
        """Begin and end of every time in which no joint moved for `least_s`."""
        still = (np.abs(self.speed_rad_s) < STILL_rad_s).all(axis=1)
        edges = np.flatnonzero(np.diff(np.concatenate(([False], still, [False])).astype(int)))
        spans = zip(edges[::2], edges[1::2] - 1, strict=True)
        return [
            (float(self.t_s[a]), float(self.t_s[b])) for a, b in spans if self.t_s[b] - self.t_s[a] >= least_s
        ]


def after_leaps(t_s: Array, q_rad: Array) -> int:
    """The first sample behind the last leap of an angle; homing gives a joint its zero."""
    leaps = np.abs(np.diff(q_rad, axis=0)).max(axis=1) > LEAP_rad + FASTEST_rad_s * np.diff(t_s)
    return int(np.flatnonzero(leaps)[-1]) + 1 if leaps.any() else 0


def begins_s(runs: Sequence[LoggedRun]) -> list[float]:
    """What to add to each run's times: where runs begin at 0 again, their cycles say how long after the run before."""
    found, cycles = [0.0], [one.extra.get("cycle") for one in runs]
    for before, after, first, then in zip(runs[:-1], runs[1:], cycles[:-1], cycles[1:], strict=True):
        is_later = float(after.t_s[0]) > float(before.t_s[-1])
        if is_later or not first or not then or len(before) < 2:
            found.append(found[-1] if is_later else 0.0)
            continue
        counts = [float(text) for text in (first[0], first[-1], then[0])]
        period_s = float(np.ptp(before.t_s)) / max(counts[1] - counts[0], 1.0)
        end_s = found[-1] + float(before.t_s[-1])
        found.append(end_s + (counts[2] - counts[1]) * period_s - float(after.t_s[0]))
    return found


def _speeds(t_s: Array, values: Array) -> Array:
    """Difference quotients over SLOPE_s around each sample."""
    before, after = np.maximum(t_s - 0.5 * SLOPE_s, t_s[0]), np.minimum(t_s + 0.5 * SLOPE_s, t_s[-1])
    columns = [
        (np.interp(after, t_s, column) - np.interp(before, t_s, column)) / (after - before)
        for column in values.T
    ]
    return np.column_stack(columns)
