"""Points from a table that another program wrote, with its own separator, decimal mark, encoding, units and column names.

What header and cells tell is taken and said; what they do not tell is `Unclear`, and nothing is guessed.
"""

from __future__ import annotations

import csv
import itertools
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from calib.arrays import Array
from calib.errors import PointsFileError, UnusablePointsError
from calib.points.points import FREE, TIP, Points, make_points, require_radians
from control.files import read_bytes
from control.model.arm import Arm

SEPARATORS: Final = {";": "semicolons", "\t": "tabs", "|": "vertical bars", ",": "commas"}
ANGLES: Final = {"rad": 1.0, "deg": np.pi / 180.0}
LENGTHS: Final = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
UNITS: Final = (  # as a header says them, the first that is found
    ("deg", r"deg|grad\b|°"),
    ("rad", r"rad"),
    ("mm", r"mm\b"),
    ("cm", r"cm\b"),
    ("m", r"m\b"),
    ("in", r"in(ch)?\b"),
)
ALONE: Final = r"(?<![^\W\d_])(?:{})(?!\w*\s*/)"  # no mrad, no µm, no deg/s
JOINT: Final = r"(?:^|[\W_])(?:(?:q|j|a|joint|axis|achse|gelenk|axe|articulation|theta|winkel|angle)[\W_]*{}|{})(?!\d)"
COLUMNS: Final = {
    **{name: rf"(?:^|[\W_]|^tip|^tcp|^pos(?:ition)?)[\W_]*{name[0]}(?![a-z])" for name in TIP},
    "setup": r"^(setup|aufbau|lage|tilt)\b",
    "point": r"^(point|punkt|pose|name|no|nr|id|place|stelle)\b",
    "repeat": r"^(repeat|rep|wiederholung|visit|take)\b",
}
NUMBER: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?", re.ASCII | re.IGNORECASE)
OPTIONAL: Final = ("setup", "point", "repeat")


class Unclear(PointsFileError):
    """The table does not tell this: the option that answers it, and what it may be."""

    def __init__(self, what: str, option: str, key: str, choices: Sequence[str]) -> None:
        super().__init__(f"{what}: answer with {option} {key}NAME; NAME is one of {', '.join(choices)}")
        self.question, self.option, self.key, self.choices = what, option, key, choices


@dataclass(frozen=True, slots=True)
class Spreadsheet:
    """A table as text, with the line of each row in the file, and how it was read."""

    path: Path
    names: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    about: str
    has_decimal_commas: bool

    def numbers(self, name: str) -> list[float]:
        """A column as numbers; PointsFileError names line and column."""
        at = self.names.index(name)
        return [self._number(row[at], line, name) for line, row in zip(self.lines, self.rows, strict=True)]

    def _number(self, cell: str, line: int, name: str) -> float:
        text = cell.translate({ord(","): ".", ord("."): ","}) if self.has_decimal_commas else cell
        number = float(text) if NUMBER.fullmatch(text) else math.inf
        if math.isinf(number):
            mark = " with a decimal comma, as others have" if self.has_decimal_commas else ""
            raise PointsFileError(f'{self.path}, line {line}, column {name}: got "{cell}", expected a number{mark}')
        return number

    def words(self, name: str) -> list[str]:
        """A column of names, none of them empty; PointsFileError names line and column."""
        cells = [row[self.names.index(name)] for row in self.rows]
        if "" in cells:
            line = self.lines[cells.index("")]
            raise PointsFileError(f"{self.path}, line {line}, column {name}: got an empty cell, expected a name")
        return cells


@dataclass(frozen=True, slots=True)
class Understood:
    """Points, and in words how each of their columns was read."""

    points: Points
    in_words: tuple[str, ...]


def read_sheet(path: Path) -> Spreadsheet:
    """The header, the first line of several filled cells, and the rows of a table. PointsFileError if it is none."""
    content = read_bytes(path)
    try:
        text, encoding = content.decode("utf-8-sig"), "UTF-8"
    except UnicodeDecodeError:
        text, encoding = content.decode("cp1252", errors="replace"), "Latin-1 (Windows 1252)"
    lines = text.splitlines()
    separated = next((line for line in lines if any(mark in line for mark in SEPARATORS)), "")
    separator = max(SEPARATORS, key=lambda mark: (separated.count(mark), mark != ","))
    reader = csv.reader(lines, delimiter=separator)
    try:
        read = [(reader.line_num, tuple(cell.strip() for cell in row)) for row in reader]
    except csv.Error as error:
        raise PointsFileError(f"{path}: no table ({error})") from None
    under_titles = itertools.dropwhile(lambda numbered: sum(map(bool, numbered[1])) < 2, read)
    table = [(line, row) for line, row in under_titles if any(row)]
    if len(table) < 2:
        raise PointsFileError(f"{path}: expected a header line and rows of several columns")
    (head, names), *below = table
    for line, row in below:
        if len(row) != len(names):
            raise PointsFileError(f"{path}, line {line}: {len(row)} values, line {head} names {len(names)}")
    numbers, rows = zip(*below, strict=True)
    commas = separator != "," and any(re.fullmatch(r"[-+]?\d*,\d+(e[-+]?\d+)?", cell) for row in rows for cell in row)
    mark = "decimal commas" if commas else "decimal points"
    about = f"{path}: {encoding}, separated by {SEPARATORS[separator]}, {mark}, {len(rows)} rows"
    return Spreadsheet(path, names, rows, numbers, about, commas)


def understood(sheet: Spreadsheet, arm: Arm, columns: Mapping[str, str], angles: str | None, lengths: str | None) -> Understood:
    """The points of a table. Unclear where it does not tell. `columns`: its names by ours; units None: as its header says."""
    joints = [f"q{j}_rad" for j in range(1, arm.joint_count + 1)]
    named_joints = enumerate(arm.joint_names, 1)
    wanted = {f"q{j}_rad": JOINT.format(j, re.escape(name.lower())) for j, name in named_joints} | COLUMNS
    if strange := [ours for ours in columns if ours not in wanted]:
        raise PointsFileError(f"--columns {strange[0]}: expected one of {', '.join(wanted)}, and = a name of theirs")
    column_of = {ours: _column(sheet, ours, pattern, columns) for ours, pattern in wanted.items()}
    of_angle, of_length = [column_of[name] or "" for name in joints], [column_of[name] or "" for name in TIP]
    notes: list[str] = []
    angle = _unit(sheet, of_angle, angles, "--angles", ANGLES, notes)
    length = _unit(sheet, of_length, lengths, "--lengths", LENGTHS, notes)
    q_rad = np.column_stack([sheet.numbers(name) for name in of_angle]) * ANGLES[angle]
    try:
        require_radians(q_rad)
    except UnusablePointsError as error:
        raise Unclear(
            f"{sheet.path}: the unit of {', '.join(of_angle)}, read as {angle}: {error}", "--angles", "", tuple(ANGLES)
        ) from None
    tip_m = np.column_stack([sheet.numbers(name) for name in of_length]) * LENGTHS[length]
    named = {ours: sheet.words(name) for ours in OPTIONAL if (name := column_of[ours])}
    setup = named.get("setup") or [FREE] * len(q_rad)
    point = named.get("point") or [f"p{k}" for k in range(1, len(q_rad) + 1)]
    if column_of["repeat"] is None:
        point = _poses_again(setup, point, q_rad, notes)
    words = [f'{ours} is "{name}"' for ours, name in column_of.items() if name]
    unused = [name for name in sheet.names if name not in column_of.values()]
    further = JOINT.format(arm.joint_count + 1, f"joint {arm.joint_count + 1}")
    if strange := [name for name in unused if re.search(further, name.lower())]:
        raise PointsFileError(
            f'{sheet.path}: column "{strange[0]}" is of joint {arm.joint_count + 1}, arm {arm.name} has {arm.joint_count}:'
            " give the right --arm, or leave the column out"
        )
    return Understood(
        make_points(setup, point, _repeats(sheet, column_of["repeat"], setup, point), q_rad, tip_m),
        (
            sheet.about,
            f"{', '.join(words)}; angles in {angle}, lengths in {length}",
            *([f"not used: {', '.join(unused)}"] if unused else []),
            *notes,
        ),
    )


def _column(sheet: Spreadsheet, ours: str, pattern: str, columns: Mapping[str, str]) -> str | None:
    if (name := columns.get(ours)) is not None:
        if name not in sheet.names:
            raise PointsFileError(f'{sheet.path}: no column "{name}" for {ours}; it has {", ".join(sheet.names)}')
        return name
    found = {name: re.search(pattern, name.lower()) for name in sheet.names if name not in columns.values()}
    matches = [name for name, match in found.items() if match and match.start() == 0]  # they begin so; else they hold it
    matches = matches or [name for name, match in found.items() if match]
    if len(matches) == 1:
        return matches[0]
    if not matches and ours in OPTIONAL:
        return None
    raise Unclear(
        f"{sheet.path}: which column is {ours}", "--columns", f"{ours}=", matches or [name for name in sheet.names if name]
    )


def _unit(
    sheet: Spreadsheet, names: Sequence[str], stated: str | None, option: str, units: Mapping[str, float], notes: list[str]
) -> str:
    """The unit of columns: as given, else what their header says. A header that says another one than was given is noted."""
    said = {next((unit for unit, form in UNITS if re.search(ALONE.format(form), name.lower())), None) for name in names}
    (unit,) = said if len(said) == 1 else (None,)
    if stated is not None:
        if unit in units and unit != stated:
            notes.append(f'{option} {stated}, although the header says {unit} ("{names[0]}"): is that right?')
        return stated
    if unit is None or unit not in units:
        raise Unclear(f"{sheet.path}: the unit of {', '.join(names)}", option, "", tuple(units))
    return unit


def _poses_again(setup: Sequence[str], point: Sequence[str], q_rad: Array, notes: list[str]) -> list[str]:
    """Names of points (m,), where rows with the same angles, q_rad (m, n), are repeats of the first of them, whatever they are
    called: a running number names every measurement, and not a pose.
    """
    first: dict[tuple[object, ...], str] = {}
    rows = zip(setup, point, q_rad.tolist(), strict=True)
    names = [first.setdefault((own, *angles), name) for own, name, angles in rows]
    if again := sum(a != b for a, b in zip(names, point, strict=True)):
        notes.append(f"rows with the angles of an earlier one: {again}, taken as repeats of its point")
    return names


def _repeats(sheet: Spreadsheet, name: str | None, setup: Sequence[str], point: Sequence[str]) -> list[int]:
    """As the table numbers them, else counted."""
    if name is not None:
        numbers = sheet.numbers(name)
        if wrong := [number for number in numbers if number != round(number)]:
            raise PointsFileError(f"{sheet.path}, column {name}: got {wrong[0]:g}, expected whole numbers")
        return list(map(round, numbers))
    seen: Counter[tuple[str, str]] = Counter()
    counted = []
    for key in zip(setup, point, strict=True):
        seen[key] += 1
        counted.append(seen[key])
    return counted
