"""Data of a report: plain dataclasses filled in by the caller."""

from __future__ import annotations

from dataclasses import dataclass

from calib.identify.identification import Identification
from calib.inputs import InputFile
from calib.report.page import Section
from calib.validation.verify import Comparison, TrackPair
from control.model.arm import Arm

UNUSED = "at points that calibration did not use"


@dataclass(frozen=True, slots=True)
class ReportData:
    """The contents of report.html. Absent parts are omitted.

    `verdict`: sentences at the top. `paths`: trajectories by the nominal and the calibrated model. `arms`: nominal
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
