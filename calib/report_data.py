"""What a report is made of: plain dataclasses that whoever ran the job fills in."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from calib.arrays import Array
from calib.identify.identification import Identification
from calib.verify import Comparison


@dataclass(frozen=True, slots=True)
class InputFile:
    """A file that the result depends on."""

    name: str
    sha256: str
    what: str


@dataclass(frozen=True, slots=True)
class Track:
    """One run along a path: time_s (k,), planned_m and measured_m (k, 3) of the tip, base frame; NaN where not seen."""

    name: str
    time_s: Array
    planned_m: Array
    measured_m: Array


@dataclass(frozen=True, slots=True)
class ReportData:
    """Everything that stands in report.html. Absent parts are left out of it."""

    title: str
    arm: str
    date: str
    program_version: str
    steps: tuple[str, ...]
    inputs: tuple[InputFile, ...] = ()
    tracks: tuple[Track, ...] = ()
    identification: Identification | None = None
    calibration: Comparison | None = None
    verification: Comparison | None = None
    notes: tuple[str, ...] = ()


def input_file(path: Path, what: str) -> InputFile:
    """Name and SHA-256 of a file as it is now."""
    with path.open("rb") as file:
        return InputFile(path.name, hashlib.file_digest(file, "sha256").hexdigest(), what)
