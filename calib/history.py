"""history.jsonl: an append-only record of calibrations and gaps, a line each. Reference: docs/formats.md.

Geometry is kept with its information matrix, since few DH parameters are determined by themselves: a
combination that a calibration does not determine has no information, and later says nothing about drift.
"""

from __future__ import annotations

import datetime
import fcntl
from pathlib import Path
from typing import Annotated, Final

import msgspec
import numpy as np

from calib.arm_problem.problem import TOOL_NAMES, ArmProblem
from calib.arrays import Array
from calib.errors import CalibrationError
from calib.gap.finding import GapFinding
from calib.identify.determinability import determinability
from calib.identify.identification import Identification
from control.files import NotWritten, append_whole, open_to_append, read_bytes, require_writable

KNOWN: Final = 1e-10  # of the largest eigenvalue of an information matrix, below which nothing is known
FORMAT = "history/1"
DIGITS = 15  # significant, of a matrix's entry: its eigenvalues differ by a factor of up to 1e8
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]


class HistoryFileError(CalibrationError):
    """An invalid history.jsonl; the message names file and line."""


class GeometryRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Parameters with a nominal value: names, values in their units, scales, and the information matrix of value / scale.

    is_tool_free: the tool was identified with them, so that they are known but for what another place of the tool does as well.
    """

    names: tuple[str, ...]
    values: tuple[float, ...]
    scales: tuple[Annotated[float, msgspec.Meta(gt=0.0)], ...]
    information: tuple[tuple[float, ...], ...]
    is_tool_free: bool = False

    def __post_init__(self) -> None:
        """Everything has the length of the names."""
        count = len(self.names)
        lengths = {len(self.values), len(self.scales), len(self.information), *map(len, self.information)}
        if not count or lengths != {count}:
            raise ValueError(f"expected {count} values, scales, and rows and columns of information")


class Quantity(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A number with its standard deviation, null if unknown."""

    value: float
    sd: NotNegative | None = None


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One line: when measured (UTC), by which command, of which arm."""

    format: str
    measured: datetime.datetime
    by: str
    arm: str
    program_version: str
    inputs: dict[str, str] = {}
    geometry: GeometryRecord | None = None
    quantities: dict[str, Quantity] = {}

    @property
    def day(self) -> float:
        """Days since 1970."""
        return self.measured.timestamp() / 86400.0


def geometry_of(problem: ArmProblem, fit: Identification) -> GeometryRecord:
    """What a calibration determined; tool, boards and other unknowns without a nominal value are projected out."""
    known = determinability(problem.sensitivity(fit.x), problem.parameters)
    inner = known.basis.T @ known.covariance(fit.noise.variance_m2) @ known.basis
    information = known.basis @ np.linalg.inv(inner) @ known.basis.T
    bounded = [k for k, one in enumerate(problem.parameters) if one.has_bound]
    about_bounded = information_about(information, bounded)
    return GeometryRecord(
        tuple(problem.parameters[k].name for k in bounded),
        tuple(fit.estimates[k].value for k in bounded),
        tuple(problem.parameters[k].scale for k in bounded),
        tuple(tuple(float(f"{value:.{DIGITS}g}") for value in row) for row in about_bounded),
        any(one.name in TOOL_NAMES for one in problem.parameters),
    )


def quantities_of(finding: GapFinding) -> dict[str, Quantity]:
    """The parameters of the effects that a gap named, such as `backlash2.width_rad`."""
    return {
        f"{effect.name.effect}{effect.name.joint or ''}.{parameter}": Quantity(value, sd if np.isfinite(sd) else None)
        for effect in finding.effects
        for parameter, (value, sd) in effect.parameters.items()
    }


def require_appendable(path: Path, arm: str) -> None:
    """CalibrationError where `path` is a history of another arm, or cannot be written: asked before anything is computed."""
    if path.exists():
        read_history(path, arm)
        return
    try:
        require_writable(path.parent)
    except NotWritten as error:
        raise HistoryFileError(f"--history {NotWritten.of(error, path)}") from None


def append_entry(path: Path, entry: Entry) -> None:
    """Append a line and wait for the disk; NotWritten if the disk is full."""
    with open_to_append(path) as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        append_whole(file.fileno(), path, msgspec.json.encode(entry) + b"\n")


def read_history(path: Path, arm: str) -> tuple[Entry, ...]:
    """All entries, by date of measurement. HistoryFileError names file and line."""
    try:
        lines = read_bytes(path).splitlines()
    except OSError as error:
        raise HistoryFileError(f"{path}: cannot be read: {error.strerror}") from None
    entries = [_entry(line, f"{path}, line {number}") for number, line in enumerate(lines, 1)]
    for number, entry in enumerate(entries, 1):
        if entry.arm != arm:
            raise HistoryFileError(f'{path}, line {number}: expected arm "{arm}", got "{entry.arm}"')
    return tuple(sorted(entries, key=lambda one: one.measured))


def _entry(line: bytes, where: str) -> Entry:
    try:
        entry = msgspec.json.decode(line, type=Entry)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise HistoryFileError(
            f"{where}: not an entry of a history ({error}): expected a line as `calibrate --history` writes it; correct it, or"
            " take it out"
        ) from None
    if entry.format != FORMAT:
        raise HistoryFileError(f'{where}: expected format "{FORMAT}", got "{entry.format}"')
    if entry.measured.tzinfo is None:
        raise HistoryFileError(f"{where}: measured: expected a date with its time zone, such as 2026-11-23T09:00:00Z")
    return entry


def measured_at(text: str | None) -> datetime.datetime:
    """The date of --measured (UTC if it names no zone), now if there is none. CalibrationError if it is not a date."""
    if text is None:
        return datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    try:
        moment = datetime.datetime.fromisoformat(text)
    except ValueError:
        raise CalibrationError(f'--measured: expected a date such as 2026-11-23 or 2026-11-23T09:00, got "{text}"') from None
    return moment if moment.tzinfo else moment.replace(tzinfo=datetime.UTC)


def information_about(information: Array, rows: list[int]) -> Array:
    """Information about some unknowns, whatever the others are (Schur complement)."""
    others = [k for k in range(len(information)) if k not in rows]
    block = information[np.ix_(rows, rows)]
    if not others:
        return block
    across = information[np.ix_(rows, others)]
    inverse = np.linalg.pinv(information[np.ix_(others, others)], rcond=KNOWN, hermitian=True)
    return np.asarray(block - across @ inverse @ across.T)
