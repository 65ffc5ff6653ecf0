"""Snapshots of the arm, from a recording or live over the runtime's socket."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from console.visualisation.series import Array, Series
from control.server.channel import Message
from firmware_iface.clock import Clock

Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Measured and commanded pose of the arm; angles in rad, the camera's tip in m or None.

    Angles of the encoders, and of the joints, which are drawn.

    `status` has currents and faults of a live snapshot.
    """

    t_s: float
    q_rad: tuple[float, ...]
    q_set_rad: tuple[float, ...]
    joint_rad: tuple[float, ...]
    joint_set_rad: tuple[float, ...]
    mode: str = ""
    camera_m: Point | None = None
    current_A: tuple[float, ...] = ()


class StatusSource(Protocol):
    """A source of statuses."""

    def status(self) -> Message: ...


def recorded(series: Series, period_s: float) -> tuple[NDArray[np.int64], Array]:
    """Rows of the series that are `period_s` apart, and their times [s]; rows with missing angles are skipped."""
    whole = np.isfinite(series.q_rad).all(axis=1)
    rows = np.flatnonzero(whole)
    if not len(rows):
        return rows, np.empty(0)
    wanted = np.arange(series.t_s[rows[0]], series.t_s[rows[-1]] + 1e-9, period_s)
    picked = rows[np.unique(np.searchsorted(series.t_s[rows], wanted).clip(max=len(rows) - 1))]
    return picked, series.t_s[picked]


def snapshot_at(series: Series, row: int) -> Snapshot:
    """The snapshot of a row; missing set-points are replaced by the measured angles."""
    mode = series.mode[row]
    seen = tuple(series.tip_m[row].tolist())
    current_A = tuple(series.current_A[row].tolist())
    return Snapshot(
        float(series.t_s[row]),
        *_angles(series.q_rad[row], series.q_set_rad[row]),
        *_angles(series.joint_rad[row], series.joint_set_rad[row]),
        series.modes[mode] if 0 <= mode < len(series.modes) else "",
        (seen[0], seen[1], seen[2]) if all(map(math.isfinite, seen)) else None,
        current_A if all(map(math.isfinite, current_A)) else (),
    )


def _angles(measured: Array, wanted: Array) -> tuple[tuple[float, ...], tuple[float, ...]]:
    known = wanted if np.isfinite(wanted).all() else measured
    return tuple(measured.tolist()), tuple(known.tolist())


def live(source: StatusSource, clock: Clock, period_s: float) -> Iterator[Snapshot]:
    """Yield a snapshot every `period_s`. RuntimeGone when the runtime ends."""
    return map(snapshot_of, live_statuses(source, clock, period_s))


def live_statuses(source: StatusSource, clock: Clock, period_s: float) -> Iterator[Message]:
    """Yield a status every `period_s`. RuntimeGone when the runtime ends."""
    next_s = clock.now_s()
    while True:
        yield source.status()
        next_s = max(next_s + period_s, clock.now_s())
        clock.wait_until_s(next_s)


def snapshot_of(status: Message) -> Snapshot:
    """The snapshot in a status."""
    camera = status.get("camera_m")
    return Snapshot(
        float(status["t_s"]),
        tuple(status["q_rad"]),
        tuple(status["q_set_rad"]),
        tuple(status.get("joint_rad") or status["q_rad"]),
        tuple(status.get("joint_set_rad") or status["q_set_rad"]),
        str(status["mode"]),
        (camera[0], camera[1], camera[2]) if camera else None,
        tuple(0.0 if value is None else float(value) for value in status["current_A"]),
    )


class CellSource:
    """The arms of a cell as one: joint angles arm after arm."""

    def __init__(self, sources: Sequence[StatusSource]) -> None:
        self._sources = tuple(sources)

    def status(self) -> Message:
        """One status, as of the first arm."""
        found = [source.status() for source in self._sources]
        keys = ("q_rad", "q_set_rad", "joint_rad", "joint_set_rad", "current_A")
        joined = {key: [value for one in found for value in one[key]] for key in keys}
        return {**found[0], **joined, "camera_m": None}
