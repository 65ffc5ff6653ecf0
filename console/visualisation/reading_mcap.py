"""Reads an MCAP file of `armwright export`, complete or truncated, as a series."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np

from console.visualisation.columns import Report, of_columns
from console.visualisation.series import Array, Series
from control.errors import ArmError
from control.model.arm import Arm
from control.recording.mcap_file import attached_arm
from control.recording.mcap_schemas import TOPICS
from control.recording.record import MODES_BEFORE_THEY_WERE_RECORDED

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
        raise ArmError(
            f"{path}: contains none of the topics {', '.join(TOPICS)}: expected an MCAP of `armwright export`"
        )
    columns = table.columns()
    joints = sum(name.startswith("q") and name.endswith("_rad") and name[1:-4].isdigit() for name in columns)
    if not joints:
        raise ArmError(f"{path}: contains no joint angles")
    modes = tuple(table.modes.get(k, f"mode {k}") for k in range(max(table.modes, default=-1) + 1))
    return of_columns(
        path.name,
        columns,
        joints,
        modes or MODES_BEFORE_THEY_WERE_RECORDED,
        arm or attached_arm(path),
        tuple(notes),
    )


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
        found = {
            key: np.concatenate([np.array(column), np.full(count - len(column), np.nan)])
            for key, column in self._columns.items()
        }
        times_ns = np.array(self.times_ns, dtype=np.int64)
        return {**found, "t_s": (times_ns - times_ns[0]) / 1e9}


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
