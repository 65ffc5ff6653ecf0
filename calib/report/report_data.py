"""What a report is made of: plain dataclasses that whoever ran the job fills in."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from calib.identify.identification import Identification
from calib.report.page import Section
from calib.validation.tracks import TrackPair
from calib.validation.verify import Comparison
from control.model.arm import Arm

UNUSED = "at points that calibration did not use"


@dataclass(frozen=True, slots=True)
class InputFile:
    """A file that the result depends on."""

    name: str
    sha256: str
    what: str


@dataclass(frozen=True, slots=True)
class ReportData:
    """Everything that stands in report.html. Absent parts are left out of it.

    `verdict`: sentences ahead of everything. `paths`: trajectories by the nominal and the calibrated model. `arms`: nominal
    and calibrated, for the table of their DH parameters. `sections`: more of them, after the comparisons. `verified_at`: where
    the verification was.
    """

    title: str
    arm: str
    date: str
    program_version: str
    steps: tuple[str, ...]
    inputs: tuple[InputFile, ...] = ()
    paths: tuple[TrackPair, ...] = ()
    identification: Identification | None = None
    calibration: Comparison | None = None
    verification: Comparison | None = None
    arms: tuple[Arm, Arm] | None = None
    notes: tuple[str, ...] = ()
    verdict: tuple[str, ...] = ()
    sections: tuple[Section, ...] = ()
    verified_at: str = UNUSED


def input_file(path: Path, what: str) -> InputFile:
    """Name and SHA-256 of a file as it is now."""
    with path.open("rb") as file:
        return InputFile(path.name, hashlib.file_digest(file, "sha256").hexdigest(), what)
