"""Snapshots of the arm, from a recording or live over the runtime's socket. Paths of the tip: commanded,
measured, and by the camera.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from console.visualisation.series import Array, Series
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.model.cell import Cell, Placed
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
        statuses = [source.status() for source in self._sources]
        keys = ("q_rad", "q_set_rad", "joint_rad", "joint_set_rad", "current_A")
        joined = {key: [value for one in statuses for value in one[key]] for key in keys}
        return {**statuses[0], **joined, "camera_m": None}


POINTS_MOST: Final = 4000
LONGEST_PATH: Final = 400
Angles = Sequence[Sequence[float]] | Array
TipsOf = Callable[[Angles], Array]
"""Tips (k, m, 3) [m] of k arms."""


@dataclass(slots=True)
class Traces:
    """Points (k, 3) in the base frame [m], in the order of time; NaN is a gap."""

    commanded_m: Array = field(default_factory=lambda: np.empty((0, 3)))
    measured_m: Array = field(default_factory=lambda: np.empty((0, 3)))
    camera_m: Array = field(default_factory=lambda: np.empty((0, 3)))


def traces_of(series: Series, tips: TipsOf) -> Traces:
    """Traces of a whole recording, thinned; gaps where an angle is missing or invalid, and between arms."""
    step = 1 + len(series) // POINTS_MOST
    placed = np.where(series.is_placed[:, None], 1.0, np.nan)
    camera = series.tip_m[np.isfinite(series.tip_m).all(axis=1) & series.is_placed]
    return Traces(
        commanded_m=_in_turn(tips((placed * series.joint_set_rad)[::step])),
        measured_m=_in_turn(tips((placed * series.joint_rad)[::step])),
        camera_m=camera[:: 1 + len(camera) // POINTS_MOST],
    )


def tips_of(kinematics: ForwardKinematics, angles_rad: Array) -> Array:
    """Tips (m, 3) of angles (m, n); NaN where an angle is NaN."""
    tips_m = np.full((len(angles_rad), 3), np.nan)
    rows = np.isfinite(angles_rad).all(axis=1)
    if rows.any():
        tips_m[rows] = kinematics.tips(angles_rad[rows])
    return tips_m


def tips_in(shown: Arm | Cell) -> TipsOf:
    """Of an arm in its base frame, or of the arms of a cell in the cell's, for joint angles (m, n), arm after arm.

    NaN where an arm is not homed.
    """
    placed_arms = shown.arms if isinstance(shown, Cell) else (Placed(shown),)
    arms = [(placed, ForwardKinematics(placed.arm)) for placed in placed_arms]

    def tips_m(angles_rad: Angles) -> Array:
        table, at, parts = np.asarray(angles_rad, dtype=np.float64), 0, []
        for placed, kinematics in arms:
            tips = tips_of(kinematics, table[:, at : at + placed.arm.joint_count])
            parts.append(tips @ np.array(placed.rotation).T + np.array(placed.origin_m))
            at += placed.arm.joint_count
        return np.array(parts)

    return tips_m


class TipPath:
    """The last tips of live arms."""

    def __init__(self, tips: TipsOf, most: int = LONGEST_PATH) -> None:
        self._tips, self._most = tips, most
        self._measured: list[Array] = []
        self._commanded: list[Array] = []
        self._camera_m: Array = np.empty((0, 3))

    def add(self, snapshot: Snapshot) -> Traces:
        """Append one snapshot; returns the paths, with gaps between those of several arms."""
        now = self._tips([snapshot.joint_rad, snapshot.joint_set_rad])
        self._measured = [*self._measured, now[:, 0]][-self._most :]
        self._commanded = [*self._commanded, now[:, 1]][-self._most :]
        if snapshot.camera_m is not None:
            self._camera_m = np.vstack([self._camera_m, snapshot.camera_m])[-self._most :]
        return Traces(_one_after_the_other(self._commanded), _one_after_the_other(self._measured), self._camera_m)


def _one_after_the_other(tips: Sequence[Array]) -> Array:
    """Points of several arms over time as one line, with a gap after each arm's."""
    return _in_turn(np.swapaxes(np.array(tips), 0, 1))


def _in_turn(tips: Array) -> Array:
    """Tips (k, m, 3) of k arms as one line, with a gap after each arm's; an only arm's as they are."""
    gap = np.full((1, 3), np.nan)
    return np.concatenate([part for arm in tips for part in (arm, gap)]) if len(tips) > 1 else tips[0]
