"""Turns a recording into what other programs read: log.csv.gz (formats.md) and MCAP (Foxglove and others).

Runs after the fact, in the command's own process. The recording itself is never changed.
"""

import csv
import gzip
import io
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

from control.loop.record import RecordError, Recording

Row = dict[str, float]
NS_PER_S = 1_000_000_000
CSV_SCALARS = ("run", "t_s", "payload_kg", "x_m", "y_m", "z_m")
CSV_JOINT = (
    "q{}_rad",
    "q{}_set_rad",
    "speed{}_rad_s",
    "speed{}_set_rad_s",
    "i{}_A",
    "u{}_V",
    "temperature{}_C",
)
CSV_REST = ("cycle", "mode", "late_s", "busy_s", "missed")


def to_csv(recording: Recording, path: Path, every: int = 1) -> int:
    """Write `path` (.csv or .csv.gz) with every k-th row of each run; returns the number of rows.

    Only runs are written, `t_s` from the start of each: what happened before the first motion is in the MCAP file. Cells are
    empty where nothing was measured.
    """
    names = _csv_columns(recording.layout.joint_count)
    with _open_text(path) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        written = 0
        for row in _run_rows(recording, every):
            writer.writerow([_cell(row[name]) for name in names])
            written += 1
    return written


def _run_rows(recording: Recording, every: int) -> Iterator[Row]:
    """Every k-th row of each run, `t_s` counted from the run's first."""
    run, number, start_s = 0.0, 0, 0.0
    for row in _rows(recording, 1):
        if row["run"] != run:
            run, number, start_s = row["run"], 0, row["t_s"]
        if run >= 1 and number % every == 0:
            yield {**row, "t_s": row["t_s"] - start_s}
        number += 1


def _csv_columns(joint_count: int) -> list[str]:
    joints = range(1, joint_count + 1)
    return [*CSV_SCALARS[:2], *(n.format(j) for n in CSV_JOINT for j in joints), *CSV_SCALARS[2:], *CSV_REST]


def _open_text(path: Path) -> TextIO:
    if path.suffix == ".gz":
        # mtime 0: the same recording gives the same bytes
        return io.TextIOWrapper(gzip.GzipFile(path, "wb", mtime=0), encoding="utf-8", newline="")
    return path.open("w", encoding="utf-8", newline="")


def _cell(value: float) -> str:
    if isinstance(value, int):
        return str(value)
    return "" if math.isnan(value) else f"{value:.9g}"


def _rows(recording: Recording, every: int) -> Iterator[Row]:
    names = recording.layout.names
    for number, row in enumerate(recording.rows()):
        if number % every == 0:
            yield dict(zip(names, row, strict=True))


def to_mcap(recording: Recording, path: Path, every: int = 1) -> int:
    """Write an MCAP file with one JSON topic each for joints, set-points, drives, tip and loop; returns the number of cycles."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer: Any = Writer(file)
        writer.start(profile="", library="armwright")
        channels = {topic: _register(writer, topic, fields) for topic, fields in TOPICS.items()}
        start_ns = int(float(recording.header.get("started_unix_s", 0.0)) * NS_PER_S)
        written = 0
        for row in _rows(recording, every):
            time_ns = start_ns + int(row["t_s"] * NS_PER_S)
            for topic, fields in TOPICS.items():
                message = _message(row, fields, recording.layout.joint_count)
                if message:
                    writer.add_message(
                        channels[topic],
                        log_time=time_ns,
                        publish_time=time_ns,
                        data=json.dumps(message).encode(),
                    )
            written += 1
        writer.finish()
    return written


# topic -> {field: (column, unit)}; a column with {} is an array over the joints, a column that is NaN is left out
TOPICS: dict[str, dict[str, tuple[str, str]]] = {
    "/joints": {"position": ("q{}_rad", "rad"), "velocity": ("speed{}_rad_s", "rad/s")},
    "/joints/set_point": {"position": ("q{}_set_rad", "rad"), "velocity": ("speed{}_set_rad_s", "rad/s")},
    "/drives": {
        "voltage": ("u{}_V", "V"),
        "current": ("i{}_A", "A"),
        "supply": ("supply{}_V", "V"),
        "temperature": ("temperature{}_C", "degC"),
        "statusword": ("statusword{}", "1"),
        "faults": ("drive_faults{}", "1"),
    },
    "/tip": {"x": ("x_m", "m"), "y": ("y_m", "m"), "z": ("z_m", "m")},
    "/loop": {
        "mode": ("mode", "1"),
        "late": ("late_s", "s"),
        "busy": ("busy_s", "s"),
        "missed": ("missed", "1"),
    },
}


def _register(writer: Any, topic: str, fields: dict[str, tuple[str, str]]) -> int:
    number: dict[str, Any] = {"type": "number"}
    shapes: dict[bool, dict[str, Any]] = {True: {"type": "array", "items": number}, False: number}
    properties = {
        name: {"description": f"[{unit}]", **shapes["{}" in column]}
        for name, (column, unit) in fields.items()
    }
    schema = {"title": topic.strip("/").replace("/", "_"), "type": "object", "properties": properties}
    schema_id = writer.register_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
    return int(writer.register_channel(topic, "json", schema_id))


def _message(row: Row, fields: dict[str, tuple[str, str]], joint_count: int) -> dict[str, Any]:
    message: dict[str, Any] = {}
    for name, (column, _) in fields.items():
        if "{}" in column:
            values = [row[column.format(joint)] for joint in range(1, joint_count + 1)]
            if not any(map(math.isnan, values)):  # JSON has no NaN, and readers stop at one
                message[name] = values
        elif not math.isnan(row[column]):
            message[name] = row[column]
    return message


def export(path: Path, out: Path, every: int = 1) -> dict[str, int]:
    """Write log.csv.gz and log.mcap of a recording into the folder `out`; returns file name -> rows. Refuses to overwrite."""
    if every < 1:
        raise RecordError(f"expected to keep every 1st, 2nd, ... cycle; got every {every}")
    recording = Recording.open(path)
    out.mkdir(parents=True, exist_ok=True)
    targets = {"log.csv.gz": to_csv, "log.mcap": to_mcap}
    for name in targets:
        if (out / name).exists():
            raise RecordError(f"{out / name} is there already: choose another folder or remove it first")
    return {name: write(recording, out / name, every) for name, write in targets.items()}
