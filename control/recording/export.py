"""Exports a recording to log.csv.gz (docs/visualisation.md), and to MCAP for Foxglove: plots with units, the arm in the 3-D
panel, events as a log. Runs after the recording, in the command's own process, and never changes the recording.

Times in MCAP are absolute: the recording's start plus the loop's clock since its first row. Topics and schemas are
those of control.recording.mcap_schemas; the arm.toml is attached, and the metadata name the source.
Events are modes, runs, missed deadlines and drive faults, as text.
"""

from __future__ import annotations

import csv
import gzip
import hashlib
import heapq
import io
import json
import math
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO, Final, TextIO

import msgspec

from control.errors import ArmError
from control.files import make_whole
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.model.cell import Cell, Placed
from control.model.description import parse_arm
from control.recording import mcap_scene as scene
from control.recording.mcap_schemas import CAMERA, ERROR, LOOP, TOPICS, columns_of, schemas_of
from control.recording.reading import RecordError, Recording, recorded_arm
from control.recording.record import END_FIELDS, JOINT_SIDE_FIELDS, LEAD_FIELD, Layout

Row = tuple[float, ...]
Point = tuple[float, float, float]
SCENE_PERIOD_s: Final = 0.02  # the refresh rate of a screen
PATH_POINTS_MOST: Final = 4000  # points per run, so that a long path can still be drawn


def to_mcap(
    recording: Recording, path: Path, every: int = 1, arm: Arm | None = None, report: Callable[[int], None] = lambda row: None
) -> int:
    """Write every k-th cycle; return the count. Without `arm` there is no 3-D scene. `report` is called every thousand rows."""
    with path.open("wb") as file:
        writer = _opened(file)
        written = _filled([_Export(recording, writer, arm)], every, report)[0]
        writer.finish()
    return written


def cell_to_mcap(
    recordings: Sequence[Recording], path: Path, cell: Cell, every: int = 1, report: Callable[[int], None] = lambda row: None
) -> int:
    """Write every k-th cycle of all arms of a cell; return the count of the first.

    An arm's topics and frames have its name before them, `/left/joints` and `left/base`; bases stand in the frame `cell`.
    """
    with path.open("wb") as file:
        writer = _opened(file)
        exports = [_Export(one, writer, placed.arm, placed) for one, placed in zip(recordings, cell.arms, strict=True)]
        written = _filled(exports, every, report)[0]
        writer.finish()
    return written


def _opened(file: BinaryIO) -> Any:
    from mcap.writer import Writer

    writer: Any = Writer(file, enable_data_crcs=True)
    writer.start(profile="", library=f"armwright {version('armwright')}")
    return writer


def _filled(exports: Sequence[_Export], every: int, report: Callable[[int], None]) -> list[int]:
    """Write the rows of all recordings by time; returns the count of each."""
    written = [0] * len(exports)
    merged = heapq.merge(*(one.rows(k) for k, one in enumerate(exports)))
    for number, (t_s, k, count, row) in enumerate(merged):
        if number == 0:
            for export in exports:
                export.origin = exports[k].start_ns, t_s
        if count % every == 0:
            exports[k].add(row)
            written[k] += 1
        if number % 1000 == 0:
            report(number // len(exports))
    for export, count in zip(exports, written, strict=True):
        export.finish(count, every)
    return written


@dataclass(slots=True)
class _Columns:
    """Column indices of one recording; joint groups as tuples."""

    place: dict[str, int]
    joint_count: int
    own: dict[str, tuple[tuple[str, int], ...]] = field(init=False)

    def __post_init__(self) -> None:
        self.own = {
            topic: tuple((n, self.place[n]) for n in columns_of(topic, self.joint_count) if n in self.place) for topic in TOPICS
        }

    def joints(self, form: str, encoders: str) -> tuple[int, ...]:
        """The joint angles; the encoder angles if joint angles were not recorded separately."""
        return self.group(form if form.format(1) in self.place else encoders)

    def group(self, form: str) -> tuple[int, ...]:
        return tuple(self.place[form.format(joint)] for joint in range(1, self.joint_count + 1))


class _Export:
    """Writes rows into an open MCAP file."""

    def __init__(self, recording: Recording, writer: Any, arm: Arm | None, placed: Placed | None = None) -> None:
        """`placed`: of an arm among others, whose name its topics and frames then have."""
        self._recording, self._writer, self._arm, self._placed = recording, writer, arm, placed
        layout = recording.layout
        self._columns = _Columns({n: k for k, n in enumerate(layout.names)}, layout.joint_count)
        self._q, self._q_set = self._columns.group("q{}_rad"), self._columns.group("q{}_set_rad")
        self._joint = self._columns.joints("joint{}_rad", "q{}_rad")
        self._joint_set = self._columns.joints("joint{}_set_rad", "q{}_set_rad")
        self._speed = self._columns.group("speed{}_rad_s")
        self._faults = self._columns.group("drive_faults{}")
        self._start_ns = int(float(recording.header.get("started_unix_s", 0.0)) * scene.NS_PER_S)
        self._first_s = math.nan
        self.origin: tuple[int, float] | None = None  # time of the day [ns] and of the loop of the first row of all arms
        self._next_scene_s = -math.inf
        self._events = CycleChanges(recording.modes)
        self._channels = self._registered(layout.joint_count)
        self._kinematics = ForwardKinematics(arm) if arm else None
        self._paths = _commanded_paths(recording, self._columns, self._kinematics) if self._kinematics else {}

    def _registered(self, joint_count: int) -> dict[str, int]:
        schemas = schemas_of(joint_count)
        ids = {
            schema["title"]: self._writer.register_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
            for schema in schemas.values()
        }
        return {
            topic: int(self._writer.register_channel(self._named(topic), "json", ids[schema["title"]]))
            for topic, schema in schemas.items()
        }

    def _named(self, topic: str) -> str:
        return topic if self._placed is None else f"/{self._placed.name}{topic}"

    @property
    def start_ns(self) -> int:
        """When the recording began."""
        return self._start_ns

    def rows(self, number: int) -> Iterator[tuple[float, int, int, Row]]:
        """Rows with their time before them, to be merged with those of other arms: time, `number`, count and row."""
        at = self._columns.place["t_s"]
        return ((row[at], number, count, row) for count, row in enumerate(self._recording.rows()))

    def add(self, row: Row) -> None:
        """One cycle."""
        at = self._columns.place
        t_s = row[at["t_s"]]
        if math.isnan(self._first_s):
            self._start_ns, self._first_s = self.origin or (self._start_ns, t_s)
            if self._arm is not None:
                self._write("/scene", scene.shapes(self._arm, self._start_ns), self._start_ns)
        time_ns = self._start_ns + round((t_s - self._first_s) * scene.NS_PER_S)
        self._own(row, time_ns)
        self._happened(row, time_ns)
        if t_s >= self._next_scene_s:
            self._next_scene_s = t_s + SCENE_PERIOD_s - 1e-6
            self._scene(row, time_ns)

    def _write(self, topic: str, message: dict[str, Any], time_ns: int) -> None:
        if self._placed is not None:
            message = scene.of_arm(message, self._placed.name)
        self._writer.add_message(self._channels[topic], log_time=time_ns, publish_time=time_ns, data=msgspec.json.encode(message))

    def _own(self, row: Row, time_ns: int) -> None:
        """The recording's columns; missing values are omitted, because JSON has no NaN."""
        for topic, columns in self._columns.own.items():
            message: dict[str, Any] = {name: row[k] for name, k in columns if math.isfinite(row[k])}
            if topic == LOOP:
                message["mode_name"] = mode_name(self._recording.modes, row[self._columns.place["mode"]])
            if message:
                self._write(topic, message, time_ns)
        error = {
            f"following_error{joint}_rad": row[wanted] - row[measured]
            for joint, (wanted, measured) in enumerate(zip(self._q_set, self._q, strict=True), start=1)
            if math.isfinite(row[wanted] - row[measured])
        }
        if error:
            self._write(ERROR, error, time_ns)
        tip = tuple(row[k] for _, k in self._columns.own[CAMERA])
        if len(tip) == 3 and all(map(math.isfinite, tip)):
            self._write("/tip/camera", scene.pose_in_base((tip[0], tip[1], tip[2]), time_ns), time_ns)

    def _happened(self, row: Row, time_ns: int) -> None:
        """Events as text, and the commanded path of a run."""
        at = self._columns.place
        run = int(row[at["run"]])
        faults = tuple(row[k] for k in self._faults)
        for level, text in self._events.look(row[at["t_s"]], int(row[at["mode"]]), run, int(row[at["missed"]]), faults):
            self._write("/log", scene.log_entry(level, text, time_ns), time_ns)
        if points := self._paths.pop(run, None):
            self._write("/scene", scene.path(points, time_ns), time_ns)

    def _scene(self, row: Row, time_ns: int) -> None:
        """Frames, tips and joint states, at the refresh rate of a screen."""
        joint_rad, wanted_rad = [row[k] for k in self._joint], [row[k] for k in self._joint_set]
        states = scene.joint_states(joint_rad, [row[k] for k in self._speed], time_ns)
        self._write("/joint_states", states, time_ns)
        if self._arm is None or self._kinematics is None:
            return
        for topic, message in scene.posed(self._arm, self._kinematics, joint_rad, wanted_rad, time_ns):
            if topic == "/tf" and self._placed is not None:
                message["transforms"].append(scene.standing(self._placed, time_ns))
            self._write(topic, message, time_ns)

    def finish(self, written: int, every: int) -> None:
        """Attach the arm, write the metadata."""
        before = "" if self._placed is None else f"{self._placed.name}."
        recording = self._recording
        if self._arm is not None and (text := _arm_text(recording, self._arm)):
            self._writer.add_attachment(
                create_time=self._start_ns,
                log_time=self._start_ns,
                name=f"{before}arm.toml",
                media_type="application/toml",
                data=text.encode(),
            )
        about = {
            "arm": recording.header.get("arm", ""),
            "recording": recording.path.name,
            "recording_sha256": _sha256(recording.path),
            "started_unix_s": recording.header.get("started_unix_s", ""),
            "period_s": recording.header.get("period_s", ""),
            "joint_count": recording.layout.joint_count,
            "cycles": written,
            "every": every,
            "program": f"armwright {version('armwright')}",
            "recorded_by": recording.header.get("program", ""),
        }
        self._writer.add_metadata(f"{before}armwright", {key: str(value) for key, value in about.items()})


def _commanded_paths(recording: Recording, columns: _Columns, kinematics: ForwardKinematics) -> dict[int, Sequence[Point]]:
    """Commanded tip path of every run [m], thinned to what a line needs."""
    at, group = columns.place, columns.joints("joint{}_set_rad", "q{}_set_rad")
    sets: dict[int, array[float]] = {}
    motion_modes = {number for number, name in enumerate(recording.modes) if name in ("MOVING", "JOGGING")}
    last_s = -math.inf
    for row in recording.rows():
        if row[at["mode"]] in motion_modes and row[at["t_s"]] - last_s >= SCENE_PERIOD_s - 1e-6:
            last_s = row[at["t_s"]]
            angles = [row[k] for k in group]
            if all(map(math.isfinite, angles)):
                sets.setdefault(int(row[at["run"]]), array("d")).extend(angles)
    return {run: _tips(kinematics, angles) for run, angles in sets.items()}


def _tips(kinematics: ForwardKinematics, angles: array[float]) -> Sequence[Point]:
    n = kinematics.joint_count
    poses = [angles[k : k + n].tolist() for k in range(0, len(angles), n)]
    step = -(-len(poses) // PATH_POINTS_MOST)
    return [(x, y, z) for x, y, z in kinematics.tips(poses[::step]).tolist()]


def _arm_text(recording: Recording, arm: Arm) -> str:
    """The recorded arm.toml, else the present file."""
    if isinstance(text := recording.header.get("arm_toml"), str):
        return text
    return arm.path.read_text(encoding="utf-8") if arm.path is not None and arm.path.is_file() else ""


def attached_arm(path: Path) -> Arm | None:
    """The arm attached to an MCAP file; None if there is no readable one."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    try:
        with path.open("rb") as file:
            for attachment in make_reader(file).iter_attachments():
                if attachment.name == "arm.toml":
                    return parse_arm(attachment.data.decode(), path)
    except (McapError, ArmError, ValueError, OSError):
        return None
    return None


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


INFORMATION, WARNING, ERROR_LEVEL = 2, 3, 4  # Foxglove's levels
SAID_EVERY_s: Final = 1.0  # missed deadlines come in bursts: one message per second is enough


class CycleChanges:
    """Compares each cycle with the last and describes the changes."""

    def __init__(self, modes: Sequence[str]) -> None:
        self._modes = tuple(modes)
        self._mode, self._run, self._missed = -1, 0, 0
        self._faults: tuple[float, ...] = ()
        self._missed_at_s = -math.inf

    def look(self, t_s: float, mode: int, run: int, missed: int, faults: tuple[float, ...]) -> Iterator[tuple[int, str]]:
        """Level and text of every new event in this cycle."""
        if mode != self._mode:
            name = mode_name(self._modes, mode)
            yield ERROR_LEVEL if name == "FAULT" else INFORMATION, f"mode {name}"
        if run != self._run:
            yield INFORMATION, f"run {run} begins"
        if missed > self._missed and t_s - self._missed_at_s >= SAID_EVERY_s:
            yield WARNING, f"{missed - self._missed} deadlines missed, {missed} so far"
            self._missed, self._missed_at_s = missed, t_s
        before = self._faults or (0.0,) * len(faults)
        for joint, (bits, known) in enumerate(zip(faults, before, strict=True), start=1):
            if bits and bits != known:
                yield ERROR_LEVEL, f"drive of joint {joint}: fault bits 0x{int(bits):02x}"
        self._mode, self._run, self._faults = mode, run, faults


def mode_name(modes: Sequence[str], number: float) -> str:
    """The name of a recorded mode; its number if unknown."""
    return modes[int(number)] if 0 <= number < len(modes) else f"mode {int(number)}"


NamedRow = dict[str, float]
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


def _run_rows(recording: Recording, every: int, report: Callable[[int], None]) -> Iterator[NamedRow]:
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


def _rows(recording: Recording) -> Iterator[NamedRow]:
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
