"""One tour: an arm goes from stop to stop, and what each gives is on the disk before it goes on.

In: a bench (the arm's client and recording), stops in order, where records go. A stop is a pose to measure, a motion to
record, or both. Out: a line of points.csv a pose, and the rows of each motion. Stops that are on the disk are passed over, so
the same tour, begun again, goes on where it was interrupted.

    for stop in tour(bench, how, stops, points, runs):
        advance(stop.name, ...)

A session with an operator, who may skip and repeat, is `calib.session`.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from calib.errors import CalibrationError
from calib.points.writer import Key, PointsWriter, Record
from calib.session.folder import continues
from calib.session.moves import RestSample
from calib.session.take import SessionSettings, wait_for_rest
from control.errors import ArmError
from control.files import write_whole
from control.motion.joint_path import JointPath
from control.motion.plan import PlannedPath
from control.recording.frame_decoder import row_type
from control.recording.reading import Recording, RowReader
from control.recording.recorder_state import has_part, next_part
from control.server.client import ArmClient
from procedures.ports import RuntimePort, camera_said

R = TypeVar("R")
Taken = TypeVar("Taken", contravariant=True)
Rows = npt.NDArray[np.void]
Angles = tuple[float, ...]
FLUSH_s = 0.3  # after a motion, until its rows are on the disk: two writes of the recorder
CAMERA_PATIENCE = 10  # averages: a marker may be hidden for a moment
CAMERA_LOOK_s = 0.5


@dataclass(frozen=True, slots=True)
class Bench:
    """A homed and holding arm: its client, the runtime's recording (if motions are recorded), who hangs loads to its tip [kg].

    speed: of moves, as a fraction of the joints' limits.
    """

    client: ArmClient
    recording: Path | None = None
    hang: Callable[[float], None] | None = None
    has_camera: bool = True
    speed: float = 1.0


@dataclass(frozen=True, slots=True)
class How:
    """How poses are taken. as_encoders: moves are to encoder angles; needs_tip: a pose without a tip ends the tour."""

    settings: SessionSettings
    as_encoders: bool = False
    needs_tip: bool = True


@dataclass(frozen=True, slots=True)
class Stop(Generic[R]):
    """One stop: past `way_rad`, to the goal: a pose at `share` of the tour's speed, or a path from the last pose of the way.

    key: of the record made there at rest, with `more` columns. run: what the motion to the goal is recorded as. due_s: not
    before, since the first stop with a time. out_rad: of a pose outside the workspace, where to come from and to return to.
    """

    name: str
    goal: Angles | PlannedPath | JointPath
    way_rad: tuple[Angles, ...] = ()
    share: float = 1.0
    key: Key | None = None
    more: Mapping[str, str] = field(default_factory=dict)
    run: R | None = None
    payload_kg: float = 0.0
    due_s: float | None = None
    out_rad: Angles | None = None


class Runs(Protocol[Taken]):
    """Where recorded motions go."""

    def has(self, run: Taken) -> bool:
        """Whether it is on the disk."""

    def keep(self, run: Taken, rows: Rows) -> None:
        """Return when it is."""


def tour(
    bench: Bench, how: How, stops: Iterable[Stop[R]], points: PointsWriter | None, runs: Runs[R] | None = None
) -> Iterator[Stop[R]]:
    """Yield each stop, then take it unless it is on the disk. Afterwards the load is off, and the arm inside the workspace.

    ArmError if the arm cannot go on, SessionError if it does not come to rest.
    """
    conductor = _Conductor(bench, how, points, runs)
    for stop in stops:
        yield stop
        if not _is_recorded(stop, points, runs):
            conductor.take(stop)
    conductor.come_back()
    conductor.hang(0.0)


def remaining(stops: Iterable[Stop[R]], points: PointsWriter | None, runs: Runs[R] | None) -> list[Stop[R]]:
    """The stops that are not on the disk yet: progress and its remaining time are those of what is still to be done."""
    return [stop for stop in stops if not _is_recorded(stop, points, runs)]


def _is_recorded(stop: Stop[R], points: PointsWriter | None, runs: Runs[R] | None) -> bool:
    """A record follows the rows of the motion to its pose, so it stands for both."""
    if stop.key is not None:
        return points is not None and stop.key in points.recorded
    return stop.run is not None and runs is not None and runs.has(stop.run)


class _Conductor(Generic[R]):
    def __init__(self, bench: Bench, how: How, points: PointsWriter | None, runs: Runs[R] | None) -> None:
        self._bench, self._how, self._points, self._runs = bench, how, points, runs
        self._port = RuntimePort(bench.client, bench.speed, how.as_encoders)
        self._rows = RunRows(bench.recording) if runs is not None and bench.recording is not None else None
        self._load_kg, self._began_s = 0.0, math.nan
        self._stands_out: tuple[Angles, object] | None = None  # the way back, and the pose where the arm stands

    def take(self, stop: Stop[R]) -> None:
        """Go there, wait, measure, keep."""
        self.hang(stop.payload_kg)
        self._wait_until(stop.due_s)
        if self._stands_out != (stop.out_rad, stop.goal):
            self.come_back()
            if stop.out_rad is not None:
                self._port.move_to_q(stop.out_rad)
                self._stands_out = stop.out_rad, stop.goal
        for q_rad in stop.way_rad:
            self._port.move_to_q(q_rad)
        if self._rows is not None and stop.run is not None:
            self._rest()
            self._rows.skip()
        self._move(stop)
        record = self._measured(stop) if stop.key is not None else None
        if self._runs is not None and stop.run is not None:
            self._runs.keep(stop.run, self._rows_of_run())
        if self._points is not None and record is not None:
            self._points.append(record)

    def come_back(self) -> None:
        """From a pose outside the workspace to its middle, before any other motion."""
        if self._stands_out is not None:
            self._port.move_to_q(self._stands_out[0])
            self._stands_out = None

    def hang(self, mass_kg: float) -> None:
        """Have this mass at the tip, hung or taken off at a pose from which every path is clear."""
        if mass_kg == self._load_kg:
            return
        if self._bench.hang is None:
            raise ArmError("nobody can hang loads to the tip: run this in a terminal, or plan without loads")
        self.come_back()
        self._bench.hang(mass_kg)
        self._load_kg = mass_kg

    def _wait_until(self, due_s: float | None) -> None:
        if due_s is None:
            return
        now_s = self._port.now_s()
        if math.isnan(self._began_s):
            self._began_s = now_s
        if (ahead_s := self._began_s + due_s - now_s) > 0.0:
            self._bench.client.wait(ahead_s)

    def _move(self, stop: Stop[R]) -> None:
        client, as_encoders = self._bench.client, self._how.as_encoders
        if isinstance(stop.goal, tuple):
            client.move_joints(stop.goal, stop.share * self._bench.speed, as_encoders=as_encoders)
        else:
            client.run_path(stop.goal.to_message(), as_encoders=as_encoders)

    def _rest(self) -> None:
        how = self._how.settings
        if math.isinf(how.still_limit_rad):  # for a time, whatever the arm still does
            self._bench.client.wait(how.still_s)
            return
        wait_for_rest(self._port, how.still_limit_rad, how.still_s, how.patience_s, how.window_s)

    def _measured(self, stop: Stop[R]) -> Record:
        self._rest()
        t_s, sample = self._port.now_s(), self._sample()
        setup, point, repeat = stop.key or ("", "", 0)
        return Record(
            setup,
            point,
            repeat,
            sample.q_rad,
            sample.q_sd_rad,
            sample.direction,
            sample.current_A,
            t_s,
            stop.payload_kg,
            None if sample.seen is None else sample.seen.tip_m,
            sample.temperature_C,
            orientation=None if sample.seen is None else sample.seen.orientation,
            more=stop.more,
        )

    def _sample(self) -> RestSample:
        """Angles and tip of the same time: an integral may still creep."""
        sees, duration_s = self._bench.has_camera and self._how.needs_tip, self._how.settings.average_s
        for _ in range(CAMERA_PATIENCE):
            sample = self._port.average(duration_s)
            if sample.seen is not None or not sees:
                return sample
        raise no_tip(self._bench.client, CAMERA_PATIENCE * duration_s)

    def _rows_of_run(self) -> Rows:
        client = self._bench.client
        client.wait(FLUSH_s)
        rows = self._rows.of_run(int(client.status()["run"])) if self._rows is not None else np.empty(0, np.void)
        if not len(rows):
            raise ArmError(f"{self._bench.recording}: contains no rows of the run that just ended: check for a full disk")
        return rows


class RunRows:
    """Reads the new rows of a growing recording, across its files."""

    def __init__(self, recording: Path) -> None:
        opened = self._open(recording)
        self._row = row_type(opened.layout.names, opened.layout.packing)

    def skip(self) -> None:
        """Skip all rows so far."""
        self._read()

    def of_run(self, number: int) -> Rows:
        """New rows of a run, as a structured array with the recording's names; an incomplete last row is left."""
        rows = np.frombuffer(self._read(), dtype=self._row)
        return np.asarray(rows[rows["run"] == number])

    def _open(self, path: Path) -> Recording:
        opened = Recording.open(path)
        self._path, self._reader = path, RowReader(opened)
        return opened

    def _read(self) -> bytes:
        """Complete rows not read yet; a part is finished once there is a next one."""
        read = b""
        while True:
            is_finished = has_part(next_part(self._path))
            read += self._reader.new()
            if not is_finished:
                return read
            self._open(next_part(self._path))


def note_plan(path: Path, document: Mapping[str, object], indent: int) -> None:
    """Write what the tour is, once. CalibrationError if the folder holds the records of another one."""
    wanted = json.dumps(document, indent=indent) + "\n"
    if path.exists() and path.read_text(encoding="utf-8") != wanted:
        raise CalibrationError(
            f"{path}: holds the records of another plan or arm: give the same options to continue, or choose another --out"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, wanted)


def no_tip(client: ArmClient, duration_s: float) -> ArmError:
    """Of a camera that measures no tip."""
    return ArmError(
        f"no tip from the camera within {duration_s:g} s{camera_said(client)}: check that it is on and sees the tip"
        " (docs/camera.md)"
    )


def bench_of(client: ArmClient, loads_kg: Iterable[float], needs_tip: bool, speed: float) -> Bench:
    """The bench of a connected arm; its operator hangs loads. ArmError unless it is homed, holds, and is seen if it has to be."""
    status = client.status()
    if status["mode"] != "HOLDING" or not status["is_homed"]:
        raise ArmError(
            f"the arm is {status['mode']}{'' if status['is_homed'] else ' and not homed'}: recording needs an arm that is homed"
            " and holding (`armwright enable`, `armwright home`)"
        )
    sees_tip = bool(client.average(CAMERA_LOOK_s).camera_frames)
    if needs_tip and not sees_tip:
        raise no_tip(client, CAMERA_LOOK_s)
    if any(loads_kg) and not sys.stdin.isatty():
        raise CalibrationError("loads are attached by hand: run this in a terminal, or omit the load")
    return Bench(client, Path(status["recording"]), _hang_by_hand, sees_tip, speed)


def _hang_by_hand(mass_kg: float) -> None:
    what = f"attach {mass_kg:.3f} kg to the tip" if mass_kg else "remove the load"
    sys.stderr.write(f"\n{what}, then press Enter: ")
    sys.stderr.flush()
    sys.stdin.readline()


@contextmanager
def telling_where(out: Path) -> Iterator[None]:
    """Whatever ends a tour early, the operator is told where its records are, if there are any."""
    try:
        yield
    except BaseException:
        if (out / "runs").exists() or any(_has_lines(out / name) for name in ("points.csv", "log.csv")):
            sys.stderr.write(f"\narmwright: {continues(out)}\n")
        raise


def _has_lines(file: Path) -> bool:
    return file.exists() and file.read_bytes().count(b"\n") > 1
