"""Rows of a .csv or .csv.gz, one after the other, in bounded memory: whatever the file is, lines, rows and bytes have an end.

A packed file of a megabyte may hold gigabytes, a sparse one a line of them, and an open quote all the rest of a file.
"""

import codecs
import csv
import gzip
import io
import os
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from control.files import open_file

LINE_MOST_bytes: Final = 1 << 20  # a line of ours has some hundreds
CELL_MOST_lines: Final = 64  # of one row: a quoted cell may hold line ends
ROWS_MOST: Final = 1_000_000
SAMPLES_MOST: Final = 5_000_000  # of a time series: over an hour at 1 kHz; forty columns of them take 1.6 GB
WHOLE_MOST_bytes: Final = 1 << 33  # 8 GB: an hour of six joints at 1 kHz has one
_HEAD_bytes: Final = 1 << 12
PACKED_FREE_bytes: Final = 1 << 26
PACKED_MOST: Final = (
    100  # times its size that a packed file may hold beyond the first 64 MB: numbers pack 3 to 20 times
)


class Rows:
    """An iterator of rows, each a list of cells; `line_num` is the file's line of the last one."""

    def __init__(self, lines: Callable[["Rows"], Iterator[str]], most: int) -> None:
        self._reader, self._most, self._count = csv.reader(lines(self)), most, 0
        self.lines_of_row = 0

    def __iter__(self) -> "Rows":
        return self

    def __next__(self) -> list[str]:
        self.lines_of_row = 0
        row = next(self._reader)
        self._count += 1
        if self._count > self._most + 1:  # the header is one
            raise _TooMuch(f"more than {self._most} rows")
        return row

    @property
    def line_num(self) -> int:
        """Number of the last line that was read, from 1."""
        return self._reader.line_num


class _TooMuch(Exception):
    """A limit of this module is passed; says which."""


@contextmanager
def opened_rows(path: Path, wrong: Callable[[str], Exception], most_rows: int = ROWS_MOST) -> Iterator[Rows]:
    """Open the rows of a file, the header's first; `wrong` makes the caller's error of the text that names file and reason."""
    try:
        with open_file(path) as file:
            size = os.fstat(file.fileno()).st_size
            if path.name.endswith(".gz"):
                most_bytes = max(PACKED_FREE_bytes, PACKED_MOST * size)
                with gzip.open(file, "rb") as packed:
                    yield Rows(lambda rows: _lines(packed, most_bytes, rows), most_rows)
            else:
                yield Rows(lambda rows: _lines(file, WHOLE_MOST_bytes, rows), most_rows)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise wrong(f"{path}: not a whole gzip file ({error})") from error
    except OSError as error:
        raise wrong(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        is_recording = path.suffix == ".armlog"
        remedy = "`armwright export` makes a log.csv.gz of it" if is_recording else "save the file in UTF-8"
        raise wrong(
            f"{path}: byte {error.start} is not UTF-8 text: expected a .csv or .csv.gz; {remedy}"
        ) from error
    except csv.Error as error:
        raise wrong(f"{path}: not comma-separated text ({error})") from error
    except _TooMuch as error:
        raise wrong(f"{path}: {error}: expected a table of ours, which is smaller") from None


def _lines(file: "io.BufferedReader | gzip.GzipFile", most_bytes: int, rows: Rows) -> Iterator[str]:
    """Lines with their ends; a lone carriage return ends one, too."""
    head = file.peek(_HEAD_bytes)[:_HEAD_bytes]
    codecs.getincrementaldecoder("utf-8")().decode(
        head
    )  # what is no text is told by its head, before its first line is
    begun = number = 0
    while line := file.readline(LINE_MOST_bytes + 1):
        number += 1
        rows.lines_of_row += 1
        if len(line) > LINE_MOST_bytes:
            raise _TooMuch(f"line {number} has more than {LINE_MOST_bytes >> 20} MB")
        if rows.lines_of_row > CELL_MOST_lines:
            raise _TooMuch(f"a quoted cell before line {number} goes on over {CELL_MOST_lines} lines")
        if begun + len(line) > most_bytes:
            raise _TooMuch(f"more than {most_bytes >> 20} MB of text")
        try:
            text = line.decode("utf-8-sig" if number == 1 else "utf-8")
        except UnicodeDecodeError as error:
            place = (begun + error.start, begun + error.end)
            raise UnicodeDecodeError(error.encoding, error.object, *place, error.reason) from None
        begun += len(line)
        if "\r" in text.removesuffix("\n").removesuffix("\r"):
            yield from io.StringIO(text, newline="")
        else:
            yield text
