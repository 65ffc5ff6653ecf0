"""Drills of files and of the loop's own process: the power fails in each write, the disk is full, a file is cut, a kill."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any
from unittest.mock import patch

from calib.errors import CalibrationError
from calib.points.writer import Key, Record
from calib.session.folder import POINTS, SessionFolder
from calib.session.plan import Mark, SessionPlan, TargetEvent, board_targets
from control.errors import ArmError
from control.files import NotWritten, write_whole
from control.hardware.connect import connect
from control.kinematics.kinematics import ForwardKinematics
from control.model.description import load_arm, save_arm
from control.recording.reading import RecordError, Recording
from control.recording.record import Layout
from control.server.channel import RuntimeGone
from control.server.client import ArmClient, RequestRefused
from firmware_iface.clock import MonotonicClock
from firmware_iface.errors import ConnectionFailed, PortInUse
from procedures.drills.drill import GOES_ON, DrillOutcome, Promise, length_m, off_way_m, stood_s
from procedures.mock import RealTimeBench, wired_to

PLAN = SessionPlan("right", "00", 3, board_targets(["normal", "roll"], ["1", "2", "3"]))
KEYS = [target.key for target in PLAN.targets]
ROOMS_bytes = range(0, 900, 15)  # after the first record: some three records and their journal
ROWS = 3
Acknowledge = Callable[[Key, Mark], None]


@dataclass(frozen=True, slots=True)
class FileDrill(Promise):
    """`check` breaks things in an empty folder, and returns how many times it did, and what was lost."""

    check: Callable[[Path], tuple[int, int]] = field(default=lambda folder: (0, 0))

    def run(self) -> DrillOutcome:
        """Break it everywhere."""
        with tempfile.TemporaryDirectory(prefix="armwright-drill-") as folder:
            times, lost = self.check(Path(folder))
        message = f"{times} places"
        return DrillOutcome(self, 0.0, 0.0, None, 0.0, f"{lost} records" if lost else "nothing", (), message, 0.0)

    @staticmethod
    def all() -> tuple[FileDrill, ...]:
        """All of them."""
        rows = (
            ("power-session", "the power fails in each write of a session", _power_in_session),
            ("power-arm", "the power fails in each write of arm.toml", _power_in_arm),
            ("power-calibration", "the power fails in each write of calibration.json", _power_in_calibration),
            ("disk-full-session", "the disk of a session is full", _full_in_session),
            ("cut-session", "points.csv and journal end anywhere in their last line", _cut_session),
            ("cut-recording", "a recording ends anywhere", _cut_recording),
        )
        return tuple(FileDrill(name, says, "files", GOES_ON, check=check) for name, says, check in rows)


def _failing(write: Callable[[int], None]) -> Iterator[tuple[int, bool]]:
    """Have the power fail at each write in turn: the number of the write, and whether all were done before."""
    for fails_at in count():
        disk, is_whole = Disk(fails_at), False
        with disk.under(), contextlib.suppress(PowerLost):
            write(fails_at)
            is_whole = True
        disk.forget()
        yield fails_at, is_whole
        if is_whole:
            return


def _power_in_session(folder: Path) -> tuple[int, int]:
    times, lost, known = 0, 0, dict[Key, Mark]()

    def write(fails_at: int) -> None:
        known.clear()
        (folder / str(fails_at)).mkdir()
        _take(folder / str(fails_at), known.__setitem__)

    for times, _ in _failing(write):
        lost += _missing(folder / str(times), known)
    return times, lost


def _take(path: Path, acknowledge: Acknowledge) -> None:
    """Records, a redo, a skip, a bad one; each is acknowledged when it has returned."""
    with SessionFolder(path, PLAN) as folder:
        for key in KEYS[:4]:
            folder.record(_record(key))
            acknowledge(key, Mark.DONE)
        for event, key, mark in (
            (TargetEvent.SKIP, KEYS[4], Mark.SKIPPED),
            (TargetEvent.BAD, KEYS[3], Mark.BAD),
            (TargetEvent.REDO, KEYS[1], Mark.LEFT),
        ):
            acknowledge(key, mark)  # either is right until it has returned: see `_missing`
            folder.happen(event, key)
        folder.note("a remark", KEYS[0])
        folder.record(_record(KEYS[1]))
        acknowledge(KEYS[1], Mark.DONE)


def _missing(path: Path, known: dict[Key, Mark]) -> int:
    """How many records that were acknowledged, and not withdrawn since, are gone; all of them if it does not open."""
    wanted = {key for key, mark in known.items() if mark is Mark.DONE}
    try:
        with SessionFolder(path, PLAN) as folder:
            return sum(folder.state.marks[key] is not Mark.DONE for key in wanted)
    except (CalibrationError, OSError):
        return max(1, len(wanted))


def _power_in_arm(folder: Path) -> tuple[int, int]:
    arm, times, lost = load_arm("right"), 0, 0
    for times, is_whole in _failing(lambda fails_at: save_arm(arm, folder / f"{fails_at}.toml")):
        path = folder / f"{times}.toml"
        if path.exists() or is_whole:
            try:
                lost += load_arm(path).drives != arm.drives
            except ArmError:
                lost += 1
    return times, lost


def _power_in_calibration(folder: Path) -> tuple[int, int]:
    path, times, lost = folder / "calibration.json", 0, 0
    older, newer = b'{"format": "calibration/1"}' * 1000, b'{"format": "calibration/1", "newer": 1}' * 1000
    path.write_bytes(older)
    for fails_at, is_whole in _failing(lambda _: write_whole(path, newer)):
        times = fails_at
        lost += path.read_bytes() not in ((newer,) if is_whole else (older, newer))
        path.write_bytes(older)
    return times, lost


def _full_in_session(folder: Path) -> tuple[int, int]:
    lost = 0
    for room in ROOMS_bytes:
        path, marks = folder / str(room), {KEYS[0]: Mark.DONE}
        with SessionFolder(path, PLAN) as session:
            session.record(_record(KEYS[0]))
            size = max(file.stat().st_size for file in path.iterdir())
            with _files_up_to(size + room):
                for key in KEYS[1:4]:
                    with contextlib.suppress(NotWritten):
                        session.record(_record(key))
                        marks[key] = Mark.DONE
            session.record(_record(KEYS[5]))
            marks[KEYS[5]] = Mark.DONE
        lost += _missing(path, marks)
    return len(ROOMS_bytes), lost


def _cut_session(folder: Path) -> tuple[int, int]:
    """A write that was cut short: all lines before it count."""
    path = folder / "session"
    with SessionFolder(path, PLAN) as session:
        for key in KEYS[:3]:
            session.record(_record(key))
            session.note("a remark", key)
    known, cuts, lost = dict.fromkeys(KEYS[:2], Mark.DONE), 0, 0
    for name in (POINTS, "journal.jsonl"):
        whole = (path / name).read_bytes()
        for end in range(whole.rstrip(b"\n").rfind(b"\n") + 1, len(whole)):
            (path / name).write_bytes(whole[:end])
            lost += _missing(path, known)
            cuts += 1
        (path / name).write_bytes(whole)
    return cuts, lost


def _cut_recording(folder: Path) -> tuple[int, int]:
    """Every whole row before the cut is read."""
    layout = Layout.of(1)
    header = layout.header({"arm": "right"})
    size, lost = layout.packing.size, 0
    row = layout.packing.pack(*(0 for _ in layout.names))
    for cut in range(ROWS * size):
        path = folder / "cut.armlog"
        path.write_bytes(header + (row * ROWS)[:cut])
        lost += sum(1 for _ in Recording.open(path).rows()) != cut // size
    return ROWS * size, lost


def _record(key: Key) -> Record:
    joints: Sequence[float] = (0.1, 0.2, 0.3)
    return Record(*key, tuple(joints), (1e-5,) * 3, (1, -1, 1), (0.2, 1.4, 0.3), 0.0, 0.0, (0.5, 0.0, 0.0), (25.0,) * 3)


@contextlib.contextmanager
def _files_up_to(size: int) -> Iterator[None]:
    """The kernel's own limit: a write that would pass it comes back short, the next fails."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


# A disk that forgets: what was not forced to it before the power failed is gone, and renames that were not are undone.
#
# The calls of the system that write are counted; at the chosen one the power fails, and nothing reaches the disk any more.
class PowerLost(BaseException):
    """No program survives this."""


class Disk:
    """The disk under a program, from now on; the power fails at call number `fails_at`, counted from 0."""

    def __init__(self, fails_at: int) -> None:
        self.calls = 0
        self._fails_at = fails_at
        self._kept: dict[int, tuple[str, int]] = {}  # by inode: path, bytes that are on the disk for certain
        self._renamed: dict[Path, bytes | None] = {}  # what was under a name before, until its folder is forced

    @contextmanager
    def under(self) -> Iterator[None]:
        """Run a program on it."""
        with (
            patch.object(os, "write", self._write),
            patch.object(os, "fsync", self._fsync),
            patch.object(os, "ftruncate", self._counted(os.ftruncate)),
            patch.object(os, "unlink", self._counted(os.unlink)),
            patch.object(os, "replace", self._named(os.replace)),
            patch.object(os, "link", self._named(os.link)),
        ):
            yield

    def forget(self) -> None:
        """The power is back: leave what was on the disk for certain."""
        for name, synced_bytes in self._kept.values():
            path = Path(name)
            if path.exists() and path.stat().st_size > synced_bytes:
                os.truncate(path, synced_bytes)
        for path, before in self._renamed.items():
            if before is None:
                path.unlink(missing_ok=True)
            else:
                path.write_bytes(before)

    def _count(self) -> None:
        if self.calls >= self._fails_at:
            raise PowerLost
        self.calls += 1

    def _counted(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*args: Any, **kwargs: Any) -> Any:
            self._count()
            return call(*args, **kwargs)

        return counted

    def _write(self, fd: int, content: bytes, _write: Callable[[int, bytes], int] = os.write) -> int:
        state = os.fstat(fd)
        self._kept.setdefault(state.st_ino, (str(_path_of(fd)), state.st_size))
        if self.calls == self._fails_at:
            _write(fd, content[: len(content) // 2])
        self._count()
        return _write(fd, content)

    def _fsync(self, fd: int, _fsync: Callable[[int], None] = os.fsync) -> None:
        self._count()
        _fsync(fd)
        path, state = _path_of(fd), os.fstat(fd)
        if path.is_dir():
            self._renamed = {name: was for name, was in self._renamed.items() if name.parent != path}
        else:
            self._kept[state.st_ino] = (str(path), state.st_size)

    def _named(self, call: Callable[..., None]) -> Callable[..., None]:
        """A call that gives a file a name: in an open folder, if it says so."""

        def named(source: Any, goal: Any, **folders: int) -> None:
            self._count()
            folder = folders.get("dst_dir_fd")
            path = (Path() if folder is None else _path_of(folder)).resolve() / goal
            before = path.read_bytes() if path.exists() else None
            call(source, goal, **folders)
            self._renamed.setdefault(path, before)
            state = path.stat()
            # Renamed before it was forced to the disk, nothing of it is there for certain.
            self._kept[state.st_ino] = (str(path), self._kept.get(state.st_ino, ("", 0))[1])

        return named


def _path_of(fd: int) -> Path:
    return Path(f"/proc/self/fd/{fd}").readlink()


FROM_rad, TO_rad = (-1.0, -0.6, 0.2), (1.2, -0.6, 0.2)
FAST_FROM_rad = -0.2  # joint 1 is at full speed from here on
LOOK_S = 0.005
SECTIONS = 500
WATCHED_S = 1.0
ARRIVES_S = 4.0
GONE = "runtime gone"


@dataclass(frozen=True, slots=True)
class RealTimeDrill(Promise):
    """The loop's process is paused for a while, or killed."""

    pause_s: float | None = None  # None: killed
    speed: float = 1.0  # of the limits

    def run(self) -> DrillOutcome:
        """Run it on a fresh mock arm."""
        with tempfile.TemporaryDirectory(prefix="armwright-drill-") as folder:
            scenario = Path(folder) / "scenario.toml"
            scenario.write_text(f'name = "drill"\n[start]\nq_rad = {list(FROM_rad)}\nhomed = true\n')
            bench = RealTimeBench("right", scenario, Path(folder) / "log")
            try:
                return self._played(bench)
            finally:
                bench.close()

    def _played(self, bench: RealTimeBench) -> DrillOutcome:
        arm = load_arm("right")
        client = bench.start(arm)
        client.enable()
        start = bench.rig.joint_rad()
        client.move_joints(TO_rad, self.speed, waits=False)
        end_s = time.monotonic() + ARRIVES_S
        while bench.rig.joint_rad()[0] < FAST_FROM_rad and time.monotonic() < end_s:
            time.sleep(LOOK_S)
        way, begun_s = [(time.monotonic(), bench.rig.tip_m())], time.monotonic()
        self._break(bench, client)
        code, message = self._found(client)
        noticed_s = time.monotonic() - begun_s
        while time.monotonic() - begun_s < (WATCHED_S if self.pause_s is None else ARRIVES_S):
            way.append((time.monotonic(), bench.rig.tip_m()))
            time.sleep(LOOK_S)
        if not code:
            code, message = self._found(client)
        tips = ForwardKinematics(arm)
        shares = [k / SECTIONS for k in range(SECTIONS + 1)]  # a joint move is a straight line of the joints
        asked = [tips.tip(*(a + share * (b - a) for a, b in zip(start, TO_rad, strict=True))) for share in shares]
        return DrillOutcome(
            self,
            max(off_way_m(tip, asked) for _, tip in way[::4]) * 1e3,
            length_m(way) * 1e3,
            noticed_s if code else None,
            stood_s(way, way[0][0], looked=4),
            "the motion" if code else "nothing",
            (code,) if code else (),
            message,
            0.0,
            self._wrong_after(client),
        )

    def _wrong_after(self, client: ArmClient) -> str:
        """What is not as promised, as text."""
        return ""

    def _break(self, bench: RealTimeBench, client: ArmClient) -> None:
        if self.pause_s is None:
            os.kill(bench.runtime_pid, signal.SIGKILL)
            return
        os.kill(bench.runtime_pid, signal.SIGSTOP)
        time.sleep(self.pause_s)
        os.kill(bench.runtime_pid, signal.SIGCONT)

    @staticmethod
    def _found(client: ArmClient) -> tuple[str, str]:
        try:
            faults = client.status()["faults"]
        except (RuntimeGone, OSError) as gone:
            return GONE, str(gone)
        return (faults[0]["code"], faults[0]["message"]) if faults else ("", "")


@dataclass(frozen=True, slots=True)
class DiskDrill(RealTimeDrill):
    """The kernel refuses the recording's next byte: the motion ends by a controlled stop, and no other begins."""

    def _break(self, bench: RealTimeBench, client: ArmClient) -> None:
        path = Path(client.status()["recorder"]["file"])
        size = path.stat().st_size
        for writer in _descendants(bench.runtime_pid):
            resource.prlimit(writer, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

    def _wrong_after(self, client: ArmClient) -> str:
        if not client.status()["was_stopped"]:
            return "the motion was not stopped"
        try:
            client.move_joints(FROM_rad)
        except RequestRefused as refusal:
            return "" if "nothing is recorded" in str(refusal) else str(refusal)
        return "a motion began unrecorded"


@dataclass(frozen=True, slots=True)
class EmptiedDrill(RealTimeDrill):
    """Another program empties the recording: what is left and what follows can be read, and the loss is counted."""

    def _break(self, bench: RealTimeBench, client: ArmClient) -> None:
        end_s = time.monotonic() + ARRIVES_S
        while not (recorder := client.status()["recorder"])["written_bytes"] and time.monotonic() < end_s:
            time.sleep(LOOK_S)  # until the writer has begun
        os.truncate(recorder["file"], 0)

    def _wrong_after(self, client: ArmClient) -> str:
        recorder = client.status()["recorder"]
        parts = sorted(Path(recorder["file"]).parent.iterdir())
        try:
            rows = [Recording.open(part).row_count for part in parts]
        except RecordError as error:
            return str(error)
        if not (recorder["is_on"] and len(rows) == 2 and max(rows)):
            return f"the recording has not gone on: {rows} cycles in its files"
        return "" if recorder["lost_rows"] else "no loss was counted"


@dataclass(frozen=True, slots=True)
class LookedAtDrill(RealTimeDrill):
    """Another program connects to the boards, as `check`, `doctor` and another `serve` do."""

    def _break(self, bench: RealTimeBench, client: ArmClient) -> None:
        arm = wired_to(load_arm("right"), bench.rig)
        try:
            connect(arm, MonotonicClock(), client.status()["period_s"]).close()
        except ConnectionFailed as failed:
            if all(isinstance(failure, PortInUse) for failure in failed.failures):
                return
        raise ArmError("another program could connect to the boards of a running arm")


def _descendants(pid: int) -> list[int]:
    """The processes that a process has started, and theirs."""
    children = [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return children + [grand for child in children for grand in _descendants(child)]
