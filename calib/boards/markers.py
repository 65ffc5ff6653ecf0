"""markers.csv: positions of a board's markers, or of the tip in the board's cavities, measured by a camera.

Required columns: setup, marker, x_m, y_m, z_m (base frame). Several rows of one marker are repeats. Other columns are ignored
with a warning. Comma-separated, .csv or .csv.gz.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arrays import Array, frozen
from calib.errors import PointsFileError
from calib.points.covariance import COVARIANCE
from calib.points.points import ORIENTATION
from calib.points.reading import require_commas
from control.tables import opened_rows

REQUIRED = ("setup", "marker", "x_m", "y_m", "z_m")


@dataclass(frozen=True, slots=True)
class Markers:
    """m measurements: setup and marker names, seen_m (m, 3) in the base frame; warnings of the reader."""

    setup: tuple[str, ...]
    marker: tuple[str, ...]
    seen_m: Array
    warnings: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Number of measurements."""
        return len(self.setup)

    def means_m(self, setup: str) -> dict[str, Array]:
        """Mean position (3,) of each marker in a setup, in order of their first measurement."""
        rows: dict[str, list[int]] = {}
        for row, (stood, name) in enumerate(zip(self.setup, self.marker, strict=True)):
            if stood == setup:
                rows.setdefault(name, []).append(row)
        return {name: self.seen_m[chosen].mean(axis=0) for name, chosen in rows.items()}


def read_markers(path: Path) -> Markers:
    """Read the measurements of a file. PointsFileError names file, line and column."""
    with opened_rows(path, PointsFileError) as reader:
        header = [name.strip() for name in next(reader, [])]
        require_commas(path, header)
        places = _places(path, header)
        rows = [_row(path, reader.line_num, header, places, row) for row in reader if row]
    if not rows:
        raise PointsFileError(f"{path}: a header and no markers: expected one line per measured marker")
    strange = [name for name in header if name not in (*REQUIRED, *ORIENTATION, *COVARIANCE)]
    warnings = (f"{path}: unknown columns ignored: {', '.join(strange)}",) if strange else ()
    return Markers(
        tuple(row[0] for row in rows),
        tuple(row[1] for row in rows),
        frozen(np.array([row[2] for row in rows])),
        warnings,
    )


def markers_text(markers: Markers) -> str:
    """The file's text."""
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow(REQUIRED)
    for setup, marker, seen in zip(markers.setup, markers.marker, markers.seen_m, strict=True):
        writer.writerow([setup, marker, *(f"{value:.7f}" for value in seen)])
    return lines.getvalue()


def _places(path: Path, header: Sequence[str]) -> tuple[int, ...]:
    for name in header:
        if header.count(name) > 1:
            raise PointsFileError(f"{path}, line 1: column {name} appears twice")
    missing = [name for name in REQUIRED if name not in header]
    if missing:
        raise PointsFileError(f"{path}, line 1: required column {missing[0]} is missing")
    return tuple(header.index(name) for name in REQUIRED)


def _row(
    path: Path, line: int, header: Sequence[str], places: Sequence[int], row: Sequence[str]
) -> tuple[str, str, list[float]]:
    if len(row) != len(header):
        raise PointsFileError(f"{path}, line {line}: {len(row)} values, line 1 names {len(header)}")
    texts = [row[place].strip() for place in places]
    for name, text in zip(REQUIRED[:2], texts[:2], strict=True):
        if not text:
            raise PointsFileError(f"{path}, line {line}, column {name}: got an empty cell, expected a name")
    return (
        texts[0],
        texts[1],
        [_number(path, line, n, t) for n, t in zip(REQUIRED[2:], texts[2:], strict=True)],
    )


def _number(path: Path, line: int, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        got = f'"{text}"' if text else "an empty cell"
        raise PointsFileError(f"{path}, line {line}, column {name}: got {got}, expected a finite number")
    return value
