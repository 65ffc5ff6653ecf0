"""Writers of a test's points.csv and log.csv: each line is saved before the arm continues."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType

from calib.iso9283.criteria.checks import Iso9283Error
from control.files import append_whole, open_to_append, read_bytes

SET = ("x_set_m", "y_set_m", "z_set_m")
TIP = ("x_m", "y_m", "z_m")
LOG_NAMES = ("programme", "cycle", "speed_m_s")


def points_header(n: int) -> list[str]:
    """Columns of points.csv: those of the interchange format, and the commanded position."""
    joints = range(1, n + 1)
    return [
        "setup", "point", "repeat", "t_s", "payload_kg", *(f"q{j}_rad" for j in joints), *(f"dir{j}" for j in joints),
        *(f"i{j}_A" for j in joints), *TIP, *SET, *(f"q{j}_sd_rad" for j in joints),
    ]  # fmt: skip


def log_header(n: int) -> list[str]:
    """Columns of log.csv: those of the interchange format, and the programme of a run."""
    joints = range(1, n + 1)
    return [
        "run", "t_s", *LOG_NAMES, *(f"q{j}_rad" for j in joints), *(f"q{j}_set_rad" for j in joints),
        *(f"joint{j}_rad" for j in joints), *(f"joint{j}_set_rad" for j in joints), "payload_kg", *TIP,
    ]  # fmt: skip


class RecordFile:
    """Appends rows to a .csv; if the process is killed, only an incomplete last line is lost.

    `rows` are those in the file when it was opened, as text by column. Iso9283Error if it has another
    header.
    """

    def __init__(self, path: Path, header: Sequence[str]) -> None:
        """Open the file, or create it with its header."""
        self._path, self._header = path, list(header)
        try:
            self._file = open_to_append(path, is_alone=True)
        except BlockingIOError:
            raise Iso9283Error(f"{path}: another program is recording into it") from None
        try:
            self.rows = self._mended()
        except BaseException:
            self._file.close()
            raise

    def _mended(self) -> list[dict[str, str]]:
        """Drop an incomplete end, write the header if there is none; the rows that are there."""
        content = read_bytes(self._path)
        whole = content[: content.rfind(b"\n") + 1]
        lines = list(csv.reader(io.StringIO(whole.decode(errors="replace")))) or [self._header]
        if lines[0] != self._header:
            raise Iso9283Error(
                f"{self._path}: its columns differ from those of this recording: choose another folder"
            )
        self._file.truncate(len(whole))
        if not whole:
            append_whole(self._file.fileno(), self._path, _line(self._header).encode())
        return [dict(zip(self._header, line, strict=True)) for line in lines[1:]]

    def append(self, rows: Iterable[Sequence[str]]) -> None:
        """Write rows and wait for the disk."""
        append_whole(self._file.fileno(), self._path, "".join(_line(row) for row in rows).encode())

    def __enter__(self) -> RecordFile:
        """Nothing to do: the file is open."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file."""
        self._file.close()


def text(value: float, decimals: int = 9) -> str:
    """Fixed decimals, empty for NaN."""
    return "" if math.isnan(value) else f"{value:.{decimals}f}"


def _line(values: Sequence[str]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(values)
    return line.getvalue()
