"""Reads recordings from .armlog, log.csv(.gz) and MCAP, recognised by their first bytes."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any, BinaryIO, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from console.visualisation.series import JOINT_FORMS, Array, Report, Series, joints_of, of_columns
from control.errors import ArmError
from control.model.arm import Arm
from control.recording.cell_folder import SAME_S, arm_of, recorded_cell, recordings_in
from control.recording.export import attached_arm
from control.recording.frame_decoder import row_type
from control.recording.mcap_schemas import TOPICS
from control.recording.reading import RecordError, Recording, recorded_arm
from control.recording.record import MAGIC, MAGIC_OF_FRAMES, MODES_BEFORE_THEY_WERE_RECORDED
from control.safety.modes import Mode

MCAP_MAGIC: Final = b"\x89MCAP0\r\n"


def read_series(path: Path, arm: Arm | None = None, report: Report = lambda done: None) -> Series:
    """Read a whole file. `arm`: its arm, if the file does not name it.

    ArmError (RecordError, LogFileError) if it is none of these files, is damaged, or has another number of joints.
    """
    if not path.is_file():
        what = "a folder; give the recording in it" if path.is_dir() else "no such file"
        raise ArmError(f"{path}: {what}; `armwright serve` records to its --log folder")
    with path.open("rb") as file:
        start = file.read(8)
    if start in (MAGIC, MAGIC_OF_FRAMES):
        recording = Recording.open(path)
        series = of_recording(recording, rows_of(recording), arm)
    elif start == MCAP_MAGIC:
        series = of_mcap(path, arm, report)
    elif start.startswith(b"\x1f\x8b") or _is_text(start):
        series = _of_log(path, arm)
    else:
        raise ArmError(
            f"{path}: expected a recording (.armlog), a log.csv or log.csv.gz, or an MCAP of `armwright export`;"
            f" {'this file is none of them' if start else 'the file is empty'}"
        )
    if arm is not None and arm.joint_count != series.joint_count:
        raise ArmError(f"{path}: {series.joint_count} joints, but arm {arm.name} has {arm.joint_count}")
    return series


def _is_text(start: bytes) -> bool:
    return bool(start) and all(byte in b"\t\r\n" or byte >= 32 for byte in start)


def rows_of(recording: Recording) -> NDArray[Any]:
    """The rows with a field a column; ArmError if this version cannot read them."""
    layout = recording.layout
    try:
        return np.frombuffer(recording.packed(), dtype=row_type(layout.names, layout.packing))
    except ValueError as error:
        raise ArmError(f"{recording.path}: {error}, which this version cannot read") from None


def of_recording(recording: Recording, rows: NDArray[Any], arm: Arm | None = None) -> Series:
    """The series of a recording's rows. ArmError if its header is cut off."""
    path, layout = recording.path, recording.layout
    count, end = recording.extent()
    size = path.stat().st_size
    if size < recording.offset:
        raise ArmError(f"{path}: the header is cut off: {recording.offset - size} bytes are missing; nothing was recorded")
    notes = []
    if size > end:
        unit = "row" if recording.columns is None else "frame"
        notes.append(f"{path}: the last {unit} is incomplete ({size - end} bytes) and was dropped")
    if count > len(rows):
        notes.append(f"{path}: {count - len(rows)} rows are damaged and were dropped")
    return of_columns(
        path.name, {name: rows[name] for name in layout.names}, recording.modes, arm or recorded_arm(recording), tuple(notes)
    )


def _of_log(path: Path, arm: Arm | None) -> Series:
    from calib.gap.log import read_log

    log, _ = read_log(path, arm.joint_count if arm else None)
    columns: dict[str, Any] = {
        "t_s": np.concatenate([run.t_s for run in log.runs]),
        "run": np.repeat(np.arange(len(log.runs)), [len(run) for run in log.runs]),
    }
    for k, axis in enumerate(("x_m", "y_m", "z_m")):
        columns[axis] = np.concatenate([run.tip_m[:, k] for run in log.runs])
    for group in ("q_rad", "q_set_rad", "current_A", "voltage_V"):
        values = np.concatenate([getattr(run, group) for run in log.runs])
        for joint in range(log.joint_count):
            columns[JOINT_FORMS[group].format(joint + 1)] = values[:, joint]
    for name in log.runs[0].extra:
        columns[name] = _numbers([text for run in log.runs for text in run.extra.get(name, ())])
    names = tuple(run.name for run in log.runs)
    modes = tuple(mode.name for mode in Mode) if "mode" in columns else ()
    return replace(of_columns(path.name, columns, modes, arm), runs=names)


def _numbers(texts: list[str]) -> Array:
    """An unknown column as numbers; NaN where a cell is not a number."""
    try:
        return np.array([text or "nan" for text in texts], dtype=np.float64)
    except ValueError:
        return np.full(len(texts), np.nan)


PER_JOINT = ("q_rad", "q_set_rad", "joint_rad", "joint_set_rad", "current_A", "voltage_V", "supply_V", "temperature_C")
ANGLES = ("q_rad", "q_set_rad", "joint_rad", "joint_set_rad")


def read_log(path: Path, arm: Arm | None = None, report: Report = lambda done: None) -> Series:
    """A file as `read_series` does, or the folder of a cell's run."""
    if not path.is_dir():
        return read_series(path, arm, report)
    if arm is not None:
        raise RecordError(f"--arm: not for {path}, a cell's folder, which has every arm's description")
    return series_of_cell(path)


def series_of_cell(folder: Path) -> Series:
    """The cycles that all arms have; angles are NaN while an arm is not homed, set-points where it has none.

    Runs and what the process says are those of the first arm. RecordError if the files are not of one run of a cell.
    """
    recordings = recordings_in(folder)
    rows = [rows_of(recording) for recording in recordings]
    common = reduce(np.intersect1d, [table["cycle"] for table in rows])
    shared = [table[np.searchsorted(table["cycle"], common)] for table in rows]
    apart_s = np.ptp([table["t_s"] for table in shared], axis=0)
    if not len(common) or apart_s.max() > SAME_S:
        names = ", ".join(arm_of(recording) for recording in recordings)
        raise RecordError(f"{folder}: {names} have no cycles in common: they are not of one run of `armwright serve`")
    per_arm = [_known(of_recording(recording, table)) for recording, table in zip(recordings, shared, strict=True)]
    first = per_arm[0]
    joined: dict[str, Any] = {name: np.hstack([getattr(series, name) for series in per_arm]) for name in PER_JOINT}
    return replace(
        first,
        **joined,
        name=folder.name,
        mode=np.full(len(first), -1),
        tip_m=np.full((len(first), 3), np.nan),
        arm=None,
        cell=recorded_cell(recordings),
        notes=tuple(note for series in per_arm for note in series.notes),
    )


def _known(series: Series) -> Series:
    """Without angles from before the arm was homed, and without set-points that it did not follow."""
    placed = np.where(series.is_placed[:, None], 1.0, np.nan)
    angles: dict[str, Any] = {name: placed * getattr(series, name) for name in ANGLES}
    followed = np.where(np.isfinite(series.following_error_rad), 1.0, np.nan)
    for name in ("q_set_rad", "joint_set_rad"):
        angles[name] = followed * angles[name]
    return replace(series, **angles)


NOT_A_NUMBER = float("nan")
REPORT_EVERY = 20_000  # messages


def of_mcap(path: Path, arm: Arm | None, report: Report) -> Series:
    """The rows written by `to_mcap`. ArmError if the file has none of our topics."""
    table, notes = _Table(), []
    total_bytes = max(1, path.stat().st_size)
    with path.open("rb") as file:
        try:
            _read(file, table, lambda: report(file.tell() / total_bytes))
        except _damage_errors() as error:
            notes.append(f"{path}: damaged or cut off ({type(error).__name__}): shown up to there")
    if not table.times_ns:
        raise ArmError(f"{path}: contains none of the topics {', '.join(TOPICS)}: expected an MCAP of `armwright export`")
    columns = table.columns()
    if not joints_of(columns):
        raise ArmError(f"{path}: contains no joint angles")
    modes = tuple(table.modes.get(k, f"mode {k}") for k in range(max(table.modes, default=-1) + 1))
    return of_columns(path.name, columns, modes or MODES_BEFORE_THEY_WERE_RECORDED, arm or attached_arm(path), tuple(notes))


def _damage_errors() -> tuple[type[Exception], ...]:
    """Exceptions of mcap's reader for truncated or damaged files."""
    import struct

    from mcap.exceptions import McapError
    from zstandard import ZstdError

    return (McapError, ZstdError, struct.error, ValueError, TypeError, OverflowError, MemoryError, EOFError)


class _Table:
    """Columns that grow by rows; messages with the same time form one row."""

    def __init__(self) -> None:
        self.times_ns: list[int] = []
        self.modes: dict[int, str] = {}
        self._columns: dict[str, array[float]] = {}

    def add(self, time_ns: int, message: dict[str, Any]) -> None:
        if time_ns >> 63:
            raise ValueError("a time beyond the year 2262")
        if not self.times_ns or time_ns != self.times_ns[-1]:
            self.times_ns.append(time_ns)
        row = len(self.times_ns) - 1
        name = message.pop("mode_name", None)
        if name is not None and "mode" in message:
            self.modes[int(message["mode"])] = str(name)
        for key, value in message.items():
            column = self._columns.setdefault(key, array("d"))
            while len(column) < row:
                column.append(NOT_A_NUMBER)
            if len(column) == row:
                column.append(value)

    def columns(self) -> dict[str, Array]:
        """Columns by name, NaN where a message lacks the field; `t_s` from the messages' times."""
        count = len(self.times_ns)
        columns = {
            key: np.concatenate([np.array(column), np.full(count - len(column), np.nan)]) for key, column in self._columns.items()
        }
        times_ns = np.array(self.times_ns, dtype=np.int64)
        return {**columns, "t_s": (times_ns - times_ns[0]) / 1e9}


def _read(file: BinaryIO, table: _Table, report: Callable[[], None]) -> None:
    """Read messages in the file's order, which works for truncated files, too."""
    from mcap.reader import NonSeekingReader

    decode = msgspec.json.Decoder(dict[str, Any]).decode
    for number, (_, _channel, message) in enumerate(
        NonSeekingReader(file).iter_messages(topics=list(TOPICS), log_time_order=False)
    ):
        table.add(message.log_time, decode(message.data))
        if number % REPORT_EVERY == 0:
            report()
