"""The reader of tables: every .csv and .csv.gz of ours, strictly by the declaration of its columns.

A `TableFormat` says which columns a file has, what a cell may be, and which columns belong together; `read_table` makes a
`TableContent` of the file, or one error that names file, line, column, what it got and what it expected. The tables of
docs/formats.md are made from the same declarations:

    POSES = TableFormat("pose", (TableColumn("point", is_name=True), TableColumn("q{}_rad", is_required=True)))
    q_rad = read_table(path, POSES, SessionError, joint_count=3).joints("q{}_rad")

`opened_rows` below it gives the rows of any file in bounded memory: lines, rows and bytes have an end. A packed file of a
megabyte may hold gigabytes, a sparse one a line of them, and an open quote all the rest of a file.
"""

import codecs
import csv
import gzip
import io
import itertools
import math
import os
import re
import zlib
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from control.errors import BadTarget
from control.files import open_file
from control.kinematics.rotation import checked_quaternion

Wrong = Callable[[str], Exception]
Array = npt.NDArray[np.float64]
LARGEST: Final = 1e18  # of any value; beyond it squares overflow, and no unit of any column gets near
WHOLE_LARGEST: Final = 2.0**53  # beyond it a float is no exact whole number

LINE_MOST_bytes: Final = 1 << 20  # a line of ours has some hundreds
CELL_MOST_lines: Final = 64  # of one row: a quoted cell may hold line ends
ROWS_MOST: Final = 1_000_000
SAMPLES_MOST: Final = 5_000_000  # of a time series: over an hour at 1 kHz; forty columns of them take 1.6 GB
WHOLE_MOST_bytes: Final = 1 << 33  # 8 GB: an hour of six joints at 1 kHz has one
_HEAD_bytes: Final = 1 << 12
_BLOCK_rows: Final = 128  # converted and checked at once; a line may have a megabyte
_ALIKE_MOST: Final = 4096  # different words of a column that are kept once each
_UNITS: Final = {"m": "metres", "rad": "radians", "kg": "kilograms", "A": "amperes", "V": "volts", "s": "seconds"}
_SEPARATORS: Final = {";": "semicolons", "\t": "tabs", "|": "vertical bars"}
PACKED_FREE_bytes: Final = 1 << 26
PACKED_MOST: Final = 100  # times its size that a packed file may hold beyond the first 64 MB: numbers pack 3 to 20 times


@dataclass(frozen=True, slots=True)
class TableColumn:
    """A column of a format: a name, a number, or a number for each joint, whose place in `name` is {}.

    is_required: the header has it; may_be_empty: lines may leave it out, by default where it is not required. lower, upper:
    inclusive bounds, which `expected` says in words. mistaken_for: another unit and its size, for a value out of bounds.
    """

    name: str
    meaning: str = ""
    is_required: bool = False
    is_name: bool = False
    is_whole: bool = False
    may_be_empty: bool | None = None
    lower: float = -LARGEST
    upper: float = LARGEST
    expected: str = ""
    mistaken_for: tuple[str, float] | None = None

    @property
    def is_empty_allowed(self) -> bool:
        """Whether a line may leave it empty."""
        return not self.is_required if self.may_be_empty is None else self.may_be_empty

    @property
    def wanted(self) -> str:
        """What a cell is to be, in words."""
        return self.expected or ("a name" if self.is_name else "a whole number" if self.is_whole else "a finite number")

    def hint(self, value: float) -> str:
        """What to write, if the value is in the unit that this one is mistaken for."""
        unit, size = self.mistaken_for or ("", math.nan)
        return f" ({unit}? then write {value * size:g})" if self.lower < value * size < self.upper else ""


@dataclass(frozen=True, slots=True)
class ColumnGroup:
    """Columns that a file has all or none of, and a line complete or empty.

    beside: columns that are there where these are, `since` these are given.
    """

    columns: tuple[str, ...]
    beside: tuple[str, ...] = ()
    since: str = ""


@dataclass(frozen=True, slots=True)
class TableFormat:
    """The columns of a file, one line for each `row`, such as "point".

    unknown: what becomes of other columns: "kept" as text, "ignored" or "refused"; a warning names those that are not `unwarned`
    (a pattern). is_padded: lines are written by hand, and may be shorter or longer than the header. too_many, separated: what to
    do about more than `most_rows`, and about other separators than commas.
    """

    row: str
    columns: tuple[TableColumn, ...]
    groups: tuple[ColumnGroup, ...] = ()
    unknown: Literal["kept", "ignored", "refused"] = "ignored"
    unwarned: str = "(?!)"
    is_padded: bool = False
    most_rows: int = ROWS_MOST
    too_many: str = "expected a table of ours, which is smaller"
    separated: str = ""


def numbered(form: str, joints: int) -> tuple[str, ...]:
    """TableColumn names of joints 1 to `joints`; the name itself, if it has no place for a number."""
    return tuple(form.format(joint) for joint in range(1, joints + 1)) if "{}" in form else (form,)


def read_table(path: Path, form: TableFormat, wrong: Wrong, joint_count: int | None = None) -> "TableContent":
    """Read a whole file. `wrong` makes the caller's error of the text that names file, line and column.

    joint_count: how many joints the file is to have; None: as many as its required column of joints says.
    """
    with opened_rows(path, wrong, form.most_rows + _BLOCK_rows) as rows:
        filled = ((row, rows.line_num) for row in rows if any(map(str.strip, row)))
        header, line = next(filled, (list[str](), 1))
        table = TableContent(path, form, wrong, tuple(name.strip() for name in header), line, joint_count)
        sized = ((table.sized(row, line), line) for row, line in filled)
        while block := list(itertools.islice(sized, _BLOCK_rows)):
            table.add([row for row, _ in block], [line for _, line in block])
    if not len(table):
        raise wrong(f"{path}: a header and no {form.row}s: expected one line per {form.row}")
    return table


class TableContent:
    """What a file holds: m rows, by the names of its columns. Numbers are NaN where the file has none."""

    def __init__(
        self, path: Path, form: TableFormat, wrong: Wrong, header: tuple[str, ...], line: int, joints: int | None
    ) -> None:
        """Check the header, which is on `line`."""
        self.path, self.form, self._wrong, self.names = path, form, wrong, header
        self._header_line = line
        self.lines = array("L")
        self.joint_count = self._counted(joints)
        declared = {name: column for column in form.columns for name in numbered(column.name, self.joint_count)}
        self.unknown = tuple(name for name in header if name not in declared)
        self._require_columns(declared)
        self._columns = {name: column for name, column in declared.items() if name in header}
        extra = self.unknown if form.unknown == "kept" else ()
        self._words: dict[str, list[str]] = {
            name: [] for name in header if name in extra or (name in declared and declared[name].is_name)
        }
        self._numbers = {name: array("d") for name in self._columns if name not in self._words}
        self._alike: dict[str, dict[str, str]] = {name: {} for name in self._words}
        self._place = {name: place for place, name in enumerate(header)}
        numeric = [self._columns[name] for name in self._numbers]
        self._lower, self._upper = (np.array([getattr(column, end) for column in numeric])[:, None] for end in ("lower", "upper"))
        self._may_be_empty, self._is_whole = (
            np.array([getattr(column, what) for column in numeric], dtype=bool)[:, None]
            for what in ("is_empty_allowed", "is_whole")
        )

    def __len__(self) -> int:
        """Number of rows, m."""
        return len(self.lines)

    def __contains__(self, name: str) -> bool:
        """Whether the file has a declared column, or one that is kept."""
        return name in self._numbers or name in self._words

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence about columns that the format does not know, if there are any."""
        strange = [name for name in self.unknown if not re.fullmatch(self.form.unwarned, name)]
        return (f"{self.path}: unknown columns ignored: {', '.join(strange)}",) if strange else ()

    def words(self, name: str) -> list[str]:
        """A column as text (m,); empty where the file has none."""
        return self._words[name] if name in self._words else [""] * len(self)

    def numbers(self, *names: str) -> Array:
        """Columns side by side, (m, columns)."""
        absent = np.full(len(self), np.nan)
        return np.column_stack([np.frombuffer(self._numbers[name]) if name in self._numbers else absent for name in names])

    def number(self, name: str) -> Array:
        """One column (m,)."""
        return self.numbers(name)[:, 0]

    def joints(self, form: str) -> Array:
        """The columns of all joints, (m, n)."""
        return self.numbers(*numbered(form, self.joint_count))

    def quaternions(self, *names: str) -> Array:
        """Unit quaternions (m, 4) of four columns, scaled to length 1."""
        quaternions = self.numbers(*names)
        for row in np.flatnonzero(np.isfinite(quaternions).all(axis=1)).tolist():
            try:
                quaternions[row] = checked_quaternion(quaternions[row].tolist())
            except BadTarget as error:
                raise self._wrong(f"{self.place(row)}: {error}") from None
        return quaternions

    def place(self, row: int) -> str:
        """File and line of a row, for errors."""
        return f"{self.path}, line {self.lines[row]}"

    def bad_cell(self, row: int, name: str, text: str, expected: str) -> Exception:
        """The caller's error for a cell that is wrong beside others."""
        return self._bad(self.lines[row], name, text, expected)

    def _bad(self, line: int, name: str, text: str, expected: str) -> Exception:
        got = f'"{text.strip()[:80]}"' if text.strip() else "an empty cell"
        return self._wrong(f"{self.path}, line {line}, column {name}: got {got}, expected {expected}")

    def _bad_header(self, text: str) -> Exception:
        return self._wrong(f"{self.path}, line {self._header_line}: {text}")

    def _counted(self, wanted: int | None) -> int:
        """The number of joints of the header, by the first column that has one for each; 0 where the format has none."""
        form = next((column.name for column in self.form.columns if "{}" in column.name), None)
        if form is None:
            return 0
        n = sum(re.fullmatch(form.format(r"\d+"), name) is not None for name in self.names)
        return wanted or n

    def _require_columns(self, declared: "dict[str, TableColumn]") -> None:
        """The header has each required column, whole groups, and nothing twice or of no joint."""
        require_commas(self.names, self._bad_header, self.form.separated)
        if self.names and all(map(_is_number, self.names)):
            needed = ", ".join(_named(column.name) for column in self.form.columns if column.is_required)
            raise self._bad_header(f"expected a header with the names of the columns ({needed}), got numbers")
        matters = self.names if self.form.unknown != "ignored" else [n for n in self.names if n in declared]
        for name in matters:
            if self.names.count(name) > 1:
                raise self._bad_header(f"column {name} appears twice")
        for column in self.form.columns:
            for name in numbered(column.name, self.joint_count or 1) if column.is_required else ():
                if name not in self.names:
                    self._require_joint_count(column)
                    raise self._bad_header(f"required column {name} is missing{self._instead(name)}")
        for column in (column for column in self.form.columns if "{}" in column.name):
            self._require_joints(column)
        for group in self.form.groups:
            self._require_whole(group.columns, group.beside)
        if self.form.unknown == "refused" and self.unknown:
            known = ", ".join(declared)
            got = self.unknown[0]
            raise self._bad_header(f'expected columns {known}, got "{got[:80]}"{self._unit(got, declared)}')

    def _instead(self, name: str) -> str:
        """What the header has in the place of a missing column."""
        if not self.names:
            return ": the file is empty"
        stem = name.rpartition("_")[0]
        near = next((other for other in self.unknown if stem and other.rpartition("_")[0] == stem), None)
        return f", got {near}{self._unit(near, [name])}" if near else f", got {', '.join(self.names)[:80]}"

    @staticmethod
    def _unit(got: str, declared: Iterable[str]) -> str:
        """What to write, if a column differs from a declared one by its unit alone."""
        stem = got.rpartition("_")[0]
        meant = next((name for name in declared if stem and name.rpartition("_")[0] == stem), "")
        unit = _UNITS.get(meant.rpartition("_")[2])
        return f": write {unit} (column {meant})" if unit else ""

    def _joints_present(self, column: TableColumn) -> tuple[str, ...]:
        pattern = column.name.format(r"\d+")
        return tuple(name for name in self.names if re.fullmatch(pattern, name))

    def _require_joint_count(self, column: TableColumn) -> None:
        """The caller's error for a file of an arm with another number of joints."""
        present, expected = self._joints_present(column), numbered(column.name, self.joint_count)
        if present and present == numbered(column.name, len(present)) != expected:
            raise self._bad_header(
                f"joint angles of {len(present)} joints, expected {len(expected)} ({expected[0]} to {expected[-1]}):"
                " is the file of another arm?"
            )

    def _require_joints(self, column: TableColumn) -> None:
        """A column of joints is there for each of them or for none, and for no other."""
        n, present = self.joint_count, self._joints_present(column)
        expected = numbered(column.name, n)
        if strange := [name for name in present if name not in expected]:
            if column.is_required:
                self._require_joint_count(column)
            raise self._bad_header(f"column {strange[0]} belongs to no joint: there are {n}")
        self._require_whole(expected, ())

    def _require_whole(self, names: Sequence[str], beside: Sequence[str]) -> None:
        """All columns of a group or none, and what stands beside them."""
        present = [name for name in names if name in self.names]
        if present and (absent := [name for name in names if name not in present]):
            raise self._bad_header(f"column {absent[0]} is missing beside {present[0]}")
        if present and any(name not in self.names for name in beside):
            raise self._bad_header(f"columns {', '.join(beside)} are missing beside {present[0]}")

    def sized(self, row: list[str], line: int) -> list[str]:
        """A row with a cell for each column of the header."""
        n = len(self.names)
        if len(row) != n and not self.form.is_padded:
            raise self._wrong(f"{self.path}, line {line}: {len(row)} values, line {self._header_line} names {n}")
        return row if len(row) == n else [*row[:n], *[""] * (n - len(row))]

    def add(self, rows: Sequence[Sequence[str]], lines: Sequence[int]) -> None:
        """Check and keep a block of rows; the first wrong line of it is the error's."""
        self.lines.extend(lines)
        if len(self) > self.form.most_rows:
            raise self._wrong(f"{self.path}: more than {self.form.most_rows} {self.form.row}s: {self.form.too_many}")
        cells = dict(zip(self.names, zip(*rows, strict=True), strict=True))
        for name, kept in self._words.items():
            kept.extend(self._shared(name, cells[name], lines))
        if not self._numbers:
            return
        values = np.array([self._floats(name, cells[name], lines) for name in self._numbers])
        is_bad = ~((values >= self._lower) & (values <= self._upper))
        is_bad &= ~(np.isnan(values) & self._may_be_empty)
        is_bad |= self._is_whole & (np.rint(values) != values) & ~np.isnan(values)
        if is_bad.any():
            row, k = (int(index) for index in np.argwhere(is_bad.T)[0])
            name = [*self._numbers][k]
            column = self._columns[name]
            wanted = column.wanted + column.hint(float(values[k, row]))
            raise self._bad(lines[row], name, cells[name][row], wanted)
        self._require_complete(values, lines, cells)
        for numbers, block in zip(self._numbers.values(), values, strict=True):
            numbers.frombytes(block.tobytes())

    def _floats(self, name: str, texts: Sequence[str], lines: Sequence[int]) -> list[float]:
        """Numbers; NaN for empty cells."""
        try:
            return [float(text) if text else math.nan for text in texts]
        except ValueError:
            pass
        numbers = []
        for text, line in zip(texts, lines, strict=True):
            try:
                numbers.append(float(text) if text.strip() else math.nan)
            except ValueError:
                raise self._bad(line, name, text, self._columns[name].wanted) from None
        return numbers

    def _shared(self, name: str, texts: Sequence[str], lines: Sequence[int]) -> list[str]:
        """Words without spaces around them; equal ones are kept once."""
        words, alike = [text.strip() for text in texts], self._alike[name]
        if "" in words and name in self._columns and not self._columns[name].is_empty_allowed:
            raise self._bad(lines[words.index("")], name, "", self._columns[name].wanted)
        if len(alike) < _ALIKE_MOST:
            alike.update((word, word) for word in words if word not in alike)
        return [alike.get(word, word) for word in words]

    def _require_complete(self, values: Array, lines: Sequence[int], cells: Mapping[str, Sequence[str]]) -> None:
        """In each line, a group is complete or empty, and what belongs beside it is there."""
        index = {name: k for k, name in enumerate(self._numbers)}
        for group in (group for group in self.form.groups if group.columns[0] in index):
            is_empty = np.isnan(values[[index[name] for name in group.columns]])
            beside = np.isnan(values[[index[name] for name in group.beside]])
            for names, is_wrong, since in (
                (
                    group.columns,
                    is_empty & ~is_empty.all(axis=0),
                    f"the rest of {group.columns[0]} to {group.columns[-1]} is given",
                ),
                (group.beside, beside & ~is_empty.all(axis=0), group.since),
            ):
                if is_wrong.any():
                    row, k = (int(at) for at in np.argwhere(is_wrong.T)[0])
                    raise self._bad(lines[row], names[k], cells[names[k]][row], f"a number, since {since}")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def require_commas(header: Sequence[str], wrong: Wrong, remedy: str = "") -> None:
    """The caller's error for a header line that is not separated by commas."""
    for mark, name in _SEPARATORS.items():
        if sum(cell.count(mark) for cell in header) > len(header):
            raise wrong(f"the columns are separated by {name}, expected commas (and decimal points in numbers){remedy}")


def documented(form: TableFormat) -> str:
    """The columns of a format as a table for docs/formats.md; neighbours of one meaning share a row."""
    rows = ["| column | required | meaning |", "| --- | --- | --- |"]
    for _, same in itertools.groupby(form.columns, key=lambda column: (column.is_required, column.meaning)):
        columns = list(same)
        names = ", ".join(_named(column.name) for column in columns)
        cells = (names, "yes" if columns[0].is_required else "", columns[0].meaning)
        rows.append("|" + "|".join(f" {cell} " if cell else " " for cell in cells) + "|")
    return "\n".join(rows) + "\n"


def _named(form: str) -> str:
    return f"`{form.format(1)}` … `{form.format('n')}`" if "{}" in form else f"`{form}`"


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
        remedy = (
            "`armwright export` makes a log.csv.gz of it"
            if is_recording
            else "save it in UTF-8; `armwright import-points` reads other encodings"
        )
        raise wrong(f"{path}: byte {error.start} is not UTF-8 text: expected a .csv or .csv.gz; {remedy}") from error
    except csv.Error as error:
        raise wrong(f"{path}: not comma-separated text ({error})") from error
    except _TooMuch as error:
        raise wrong(f"{path}: {error}: expected a table of ours, which is smaller") from None


def _lines(file: "io.BufferedReader | gzip.GzipFile", most_bytes: int, rows: Rows) -> Iterator[str]:
    """Lines with their ends; a lone carriage return ends one, too."""
    head = file.peek(_HEAD_bytes)[:_HEAD_bytes]
    codecs.getincrementaldecoder("utf-8")().decode(head)  # what is no text is told by its head, before its first line is
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
