"""Writes points.csv: a whole file at once, or record by record without losing a confirmed one."""

from __future__ import annotations

import csv
import gzip
import io
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calib.errors import SessionError
from calib.points.points import COVARIANCE, ORIENTATION, SCALARS, STREAM_FRAME, TIP, Points, read_points
from control.files import KeptLines, write_whole
from firmware_iface.link import Closing

Key = tuple[str, str, int]
POSE_COLUMNS = (*ORIENTATION, "frame")
DISTANCE = "distance_m"  # between the tips of two arms in contact


@dataclass(frozen=True, slots=True)
class Record:
    """One recorded pose of a session: names, joint angles with their scatter, and the tip if known.

    temperature_C of the drives, empty if not measured; approach: number of the side, from 1; take: 2 and more
    if earlier records of this pose were withdrawn. orientation: of the measured target, in the tip's frame.
    more: texts of further columns, by name.
    """

    setup: str
    point: str
    repeat: int
    q_rad: tuple[float, ...]
    q_sd_rad: tuple[float, ...]
    direction: tuple[int, ...]
    current_A: tuple[float, ...]
    t_s: float
    payload_kg: float
    tip_m: tuple[float, float, float] | None
    temperature_C: tuple[float, ...] = ()
    approach: int = 1
    take: int = 1
    orientation: tuple[float, float, float, float] | None = None
    more: Mapping[str, str] = field(default_factory=dict)

    @property
    def key(self) -> Key:
        """Key of a record."""
        return self.setup, self.point, self.repeat


def write_points(path: Path, points: Points) -> None:
    """Write all points, replacing the file atomically; empty columns are omitted."""
    n, q = points.joint_count, range(points.joint_count)
    columns: dict[str, Sequence[str]] = {"setup": points.setup, "point": points.point, "repeat": [str(r) for r in points.repeat]}
    if np.isfinite(points.t_s).any():
        columns["t_s"] = [cell(v, 3) for v in points.t_s]
    if np.isfinite(points.payload_kg).any():
        columns["payload_kg"] = [cell(v, 6) for v in points.payload_kg]
    columns |= {f"q{j + 1}_rad": [cell(v, 12) for v in points.q_rad[:, j]] for j in q}
    if points.direction.any():
        columns |= {f"dir{j + 1}": [cell(v, 0) for v in points.direction[:, j]] for j in range(n)}
    if np.isfinite(points.current_A).any():
        columns |= {f"i{j + 1}_A": [cell(v, 6) for v in points.current_A[:, j]] for j in q}
    if np.isfinite(points.tip_m).any():
        columns |= {name: [cell(v, 9) for v in points.tip_m[:, k]] for k, name in enumerate(TIP)}
    if np.isfinite(points.orientation).any():
        quaternion = points.orientation.T
        columns |= {name: [cell(v, 9) for v in quaternion[k]] for k, name in enumerate(ORIENTATION)}
    for k, name in enumerate(COVARIANCE):
        if np.isfinite(points.covariance[:, k]).any():
            columns[name] = ["" if math.isnan(v) else f"{v:.6e}" for v in points.covariance[:, k]]
    columns |= points.extra
    lines = [_line(list(columns)), *(_line(row) for row in zip(*columns.values(), strict=True))]
    replace_file(path, "".join(f"{line}\n" for line in lines).encode())


class PointsWriter(Closing):
    """Appends records to a .csv; each is on the disk before `append` returns (`KeptLines`).

    An existing file is continued, and so are its times, where a runtime was started anew. `warnings`: of a dropped incomplete
    line. SessionError if the file is of another arm or was not written by a session.
    """

    def __init__(self, path: Path, joint_count: int, pose_frame: str = "", more: Sequence[str] = ()) -> None:
        """Open or create the file. pose_frame: "base" or "stream", the frame of full poses; empty: tips without orientations.

        more: columns that come last, of `Record.more`.
        """
        if path.name.endswith(".gz"):
            raise SessionError(f"{path}: a session writes plain .csv, not .gz; name another file")
        self._joint_count, self._pose_frame, self._more = joint_count, pose_frame, tuple(more)
        columns = [*_header(joint_count), *(POSE_COLUMNS if pose_frame else ()), *more]
        self._header, self._take = _line(columns), columns.index("take")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._last_s, self._ahead_s = (-math.inf, 0.0)  # of the file's times: their end, and how far ahead of the arm's clock
        self._file = KeptLines(path, SessionError, self._header)
        self._paused_s = max(0.0, time.time() - path.stat().st_mtime)
        torn = self._file.torn.decode(errors="replace")
        self.warnings = (f'{path}: the last line is incomplete and is dropped: "{torn[:60]}"',) if torn else ()
        try:
            self._lines: dict[Key, str] = self._read()
        except BaseException:
            self._file.close()
            raise

    @property
    def recorded(self) -> frozenset[Key]:
        """The records in the file."""
        return frozenset(self._lines)

    def line(self, key: Key) -> str:
        """A record as a line of the file, without the line end."""
        return self._lines[key]

    def take(self, line: str) -> int:
        """The number of the take that a line of the file is."""
        return int(next(csv.reader([line]))[self._take])

    def append(self, record: Record) -> None:
        """Write one record and wait for the disk."""
        if record.key in self._lines:
            raise SessionError(f"{self._file.path}: {' '.join(map(str, record.key))} is recorded already")
        if record.t_s + self._ahead_s < self._last_s:
            self._ahead_s = self._last_s + self._paused_s - record.t_s
        self._last_s = record.t_s + self._ahead_s
        line = _line(self._row(replace(record, t_s=self._last_s)))
        self._file.append(line)
        self._lines[record.key] = line

    def withdraw(self, key: Key) -> None:
        """Remove a record; the file is replaced atomically. The caller must save the line first."""
        rest = {other: line for other, line in self._lines.items() if other != key}
        self._file.replace(self._header, *rest.values())
        self._lines = rest

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read(self) -> dict[Key, str]:
        """The lines of the records in the file, by key. PointsFileError for an invalid one."""
        lines = [line.decode(errors="replace") for line in self._file.lines]
        if not lines:
            return {}
        points, _ = read_points(self._file.path, self._joint_count)  # which refuses what is not UTF-8
        if np.isfinite(points.t_s).any():
            self._last_s = float(np.nanmax(points.t_s))
        keys = list(zip(points.setup, points.point, points.repeat, strict=True))
        if len(keys) != len(lines) or len(set(keys)) < len(keys):
            raise SessionError(f"{self._file.path}: a point appears twice, or a line is empty: undo manual edits")
        return dict(zip(keys, lines, strict=True))

    def _row(self, record: Record) -> list[str]:
        if not len(record.q_rad) == len(record.q_sd_rad) == self._joint_count:
            raise SessionError(f"a record of {len(record.q_rad)} joints, expected {self._joint_count}")
        if not all(math.isfinite(q) for q in record.q_rad):
            raise SessionError(f"{' '.join(map(str, record.key))}: a joint angle is not a finite number")
        return [
            record.setup,
            record.point,
            str(record.repeat),
            cell(record.t_s, 3),
            cell(record.payload_kg, 6),
            *(cell(q, 9) for q in record.q_rad),
            *(str(d) for d in record.direction),
            *(cell(i, 4) for i in record.current_A),
            *(cell(x, 7) for x in record.tip_m or (math.nan,) * 3),
            *(cell(sd, 9) for sd in record.q_sd_rad),
            *(cell(t, 1) for t in record.temperature_C or (math.nan,) * self._joint_count),
            str(record.approach),
            str(record.take),
            *(self._pose(record) if self._pose_frame else ()),
            *(record.more[name] for name in self._more),
        ]

    def _pose(self, record: Record) -> tuple[str, ...]:
        quaternion = (cell(value, 9) for value in record.orientation or (math.nan,) * 4)
        return (*quaternion, STREAM_FRAME if self._pose_frame == STREAM_FRAME else "")


def _header(n: int) -> list[str]:
    """Columns of a session's file."""
    joints = range(1, n + 1)
    return [
        "setup",
        "point",
        "repeat",
        *SCALARS,
        *(f"q{j}_rad" for j in joints),
        *(f"dir{j}" for j in joints),
        *(f"i{j}_A" for j in joints),
        *TIP,
        *(f"q{j}_sd_rad" for j in joints),
        *(f"temperature{j}_C" for j in joints),
        "approach",
        "take",
    ]


def cell(value: float, decimals: int) -> str:
    """Fixed decimals, empty for NaN."""
    return "" if math.isnan(value) else f"{value:.{decimals}f}"


def _line(values: Sequence[str]) -> str:
    """One line of comma-separated text, quoted where a name needs it."""
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(values)
    return line.getvalue()


def replace_file(path: Path, content: bytes) -> None:
    """Replace a file atomically: a reader sees the old one or the new one."""
    write_whole(path, gzip.compress(content, mtime=0) if path.name.endswith(".gz") else content)
