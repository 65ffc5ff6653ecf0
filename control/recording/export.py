"""Exports a recording to log.csv.gz (docs/visualisation.md) and MCAP (control.recording.mcap_file).

Runs after the recording, in the command's own process, and never changes the recording.
"""

import csv
import gzip
import io
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TextIO

from control.files import make_whole
from control.model.arm import Arm
from control.recording.mcap_file import to_mcap
from control.recording.reading import RecordError, Recording, recorded_arm
from control.recording.record import END_FIELDS, JOINT_SIDE_FIELDS, LEAD_FIELD, Layout

Row = dict[str, float]
CSV_SCALARS = ("run", "t_s", "payload_kg", "x_m", "y_m", "z_m")
CSV_JOINT = ("q{}_rad", "q{}_set_rad", "speed{}_rad_s", "speed{}_set_rad_s", "i{}_A", "u{}_V", "temperature{}_C", "counted{}_s")
DIGITS, STAMP_DIGITS = 9, 12  # a board that is on for ten days stamps 1e6 s, to the microsecond
CSV_REST = ("cycle", "mode", "late_s", "busy_s", "missed")


def to_csv(recording: Recording, path: Path, every: int = 1, report: Callable[[int], None] = lambda row: None) -> int:
    """Write `path` (.csv or .csv.gz) with every k-th row of each run; returns the number of rows.

    Only runs are written, with `t_s` from the start of each; cycles before the first motion are in the MCAP file only. Cells are
    empty where nothing was measured. `report` is called every thousand rows.
    """
    names = _csv_columns(recording.layout)
    digits = [STAMP_DIGITS if name.startswith("counted") else DIGITS for name in names]
    with open_text(path) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        written = 0
        for row in _run_rows(recording, every, report):
            writer.writerow([csv_cell(row[name], n) for name, n in zip(names, digits, strict=True)])
            written += 1
    return written


def _run_rows(recording: Recording, every: int, report: Callable[[int], None]) -> Iterator[Row]:
    """Every k-th row of each run, `t_s` counted from the run's first."""
    run, number, start_s = 0.0, 0, 0.0
    for count, row in enumerate(_rows(recording)):
        if count % 1000 == 0:
            report(count)
        if row["run"] != run:
            run, number, start_s = row["run"], 0, row["t_s"]
        if run >= 1 and number % every == 0:
            yield {**row, "t_s": row["t_s"] - start_s}
        number += 1


def _csv_columns(layout: Layout) -> list[str]:
    joints = range(1, layout.joint_count + 1)
    forms = [*(form for form, _ in JOINT_SIDE_FIELDS), LEAD_FIELD[0]]
    more = [form.format(j) for form in forms for j in joints] + [name for name, _ in END_FIELDS]
    return [
        *CSV_SCALARS[:2],
        *(name for n in CSV_JOINT for j in joints if (name := n.format(j)) in layout.names),
        *CSV_SCALARS[2:],
        *CSV_REST,
        *(name for name in more if name in layout.names),
    ]


def open_text(path: Path) -> TextIO:
    """A text file to write; compressed if its name ends in .gz."""
    if path.suffix == ".gz":
        # mtime 0: the same recording gives the same bytes
        return io.TextIOWrapper(gzip.GzipFile(path, "wb", mtime=0), encoding="utf-8", newline="")
    return path.open("w", encoding="utf-8", newline="")


def csv_cell(value: float, digits: int = DIGITS) -> str:
    """A number of a recording; empty for what is not there yet: NaN, or a time before all others."""
    if isinstance(value, int):
        return str(value)
    return f"{value:.{digits}g}" if math.isfinite(value) else ""


def _rows(recording: Recording) -> Iterator[Row]:
    names = recording.layout.names
    for row in recording.rows():
        yield dict(zip(names, row, strict=True))


def export(
    path: Path, out: Path, every: int = 1, arm: Arm | None = None, report: Callable[[float], None] = lambda done: None
) -> dict[str, int]:
    """Write log.csv.gz and log.mcap of a recording into the folder `out`; returns file name -> rows. Refuses to overwrite.

    `arm` is drawn in Foxglove's 3-D panel; by default that of the recording's header. `report` gets the share done.
    """
    if every < 1:
        raise RecordError(f"every: expected a cycle count of 1 or more, got {every}")
    recording = Recording.open(path)
    drawn = arm or recorded_arm(recording)
    if arm is not None and arm.joint_count != recording.layout.joint_count:
        raise RecordError(
            f"{path}: expected a recording of {arm.joint_count} joints, as arm {arm.name} has, got {recording.layout.joint_count}"
        )
    out.mkdir(parents=True, exist_ok=True)
    for name in ("log.csv.gz", "log.mcap"):
        if (out / name).exists():
            raise RecordError(f"{out / name} already exists: choose another folder or remove it first")
    rows = max(1, recording.row_count)
    return {
        "log.csv.gz": make_whole(
            out / "log.csv.gz", lambda file: to_csv(recording, file, every, lambda row: report(0.3 * row / rows))
        ),
        "log.mcap": make_whole(
            out / "log.mcap", lambda file: to_mcap(recording, file, every, drawn, lambda row: report(0.3 + 0.7 * row / rows))
        ),
    }
