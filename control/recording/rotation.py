"""A recording as a row of files: begun anew at a size, each readable by itself, the oldest removed beyond a total.

A disk that takes no more costs rows, never the recording: it is tried again every second. A file always ends with a whole
row, and a gap is seen in the rows' own times and cycle numbers.
"""

import contextlib
import errno
import fcntl
import os
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from control.recording.record import Recording, header_bytes, next_part
from control.recording.recorder_state import RecorderState, hours_left

RETRY_s = 1.0
SYNC_bytes = 1 << 18  # how often the kernel is asked to put the file on the disk, for power cuts
ROOM_AGAIN_s = 60.0  # of rows that must fit before a recording goes on that a full disk stopped
NAME = re.compile(r"(?P<arm>.+)-\d{8}-\d{6}(-\d+)?(\.part\d+)?\.armlog")
PWrite = Callable[[int, bytes, int], int]
Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Policy:
    """At which size a new file begins, and how much all files of an arm may take together (0: no limit)."""

    rotate_bytes: int
    keep_bytes: int = 0


class PartFile:
    """A file of a recording that has its header; grows by whole rows only. `pwrite` is the disk."""

    def __init__(self, path: Path, pwrite: PWrite = os.pwrite) -> None:
        opened = Recording.open(path)
        self.path, self.header, self.row_bytes = path, opened.header, opened.layout.packing.size
        self._rows_at, self._pwrite, self._unsynced = opened.offset, pwrite, 0
        self.size = self._rows_at + opened.row_count * self.row_bytes
        self._fd = os.open(path, os.O_WRONLY)
        with contextlib.suppress(OSError):  # tells other runtimes that this file is not finished
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)

    @property
    def is_removed(self) -> bool:
        """Whether somebody has removed it, as one does to make room."""
        return os.fstat(self._fd).st_nlink == 0

    @property
    def has_rows(self) -> bool:
        """Whether there is anything but the header."""
        return self.size > self._rows_at

    def append(self, rows: bytes) -> None:
        """Write whole rows. OSError where not all of them fit: those that do are kept, none is torn."""
        at, left = self.size, rows
        try:
            while left:
                written = self._pwrite(self._fd, left, at)
                at, left = at + written, left[written:]
        finally:
            self.size = at - (at - self._rows_at) % self.row_bytes
            self._unsynced += len(rows) - len(left)
            if at != self.size:
                with contextlib.suppress(OSError):
                    os.ftruncate(self._fd, self.size)

    def synchronise(self, least_bytes: int = 1) -> None:
        """Wait for the disk, if so much was written since the last time."""
        if self._unsynced >= least_bytes:
            self._unsynced = 0
            os.fdatasync(self._fd)

    def close(self) -> None:
        """Put it on the disk and close it."""
        try:
            self.synchronise()
        finally:
            os.close(self._fd)


class Parts:
    """Appends rows to the recording `first`, which has its header, and to the parts after it.

    `say` is told once when rows are lost and once when they are kept again. `now_s` times the retries.
    """

    def __init__(
        self,
        first: Path,
        policy: Policy,
        say: Say,
        pwrite: PWrite = os.pwrite,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._policy, self._say, self._pwrite, self._now_s = policy, say, pwrite, now_s
        part = PartFile(first, pwrite)
        self._part: PartFile | None = part
        self._path, self._header, self.row_bytes = first, part.header, part.row_bytes
        self._finished_bytes, self._retry_at_s, self._lost_before = 0, 0.0, 0
        rate = 3600.0 * part.row_bytes / float(part.header.get("period_s") or 1.0)
        self._state = RecorderState(True, str(first), since_unix_s=time.time(), bytes_per_h=rate)
        remove_oldest(first, policy, say)

    def append(self, rows: bytes) -> None:
        """Keep whole rows, or count those that the disk did not take."""
        if not self._state.is_on and self._now_s() < self._retry_at_s:
            self._lose(len(rows))
            return
        kept = 0
        try:
            part = self._prepared(len(rows))
            begun = part.size
            try:
                part.append(rows)
            finally:
                kept = part.size - begun
            part.synchronise(SYNC_bytes if self._state.is_on else 1)
        except OSError as error:
            self._stop(error)
        else:
            self._go_on()
        self._lose(len(rows) - kept)

    def state(self) -> RecorderState:
        """How the recording stands now."""
        size = self._part.size if self._part is not None else 0
        left = hours_left(self._path.parent, self._state.bytes_per_h)
        return replace(
            self._state, file=str(self._path), written_bytes=self._finished_bytes + size, hours_left=left
        )

    def close(self) -> None:
        """Put everything on the disk and close."""
        try:
            self._finish_part()
        except OSError as error:
            self._stop(error)
        if not self._state.is_on:
            self._say(f"{self._path}: the recording ends with {self._state.lost_rows} rows lost")

    def _prepared(self, more_bytes: int) -> PartFile:
        """The part that takes `more_bytes`; OSError where there is no room."""
        if not self._state.is_on:
            self._require_room()
        part = self._part
        if part is not None and (
            part.is_removed or (part.has_rows and part.size + more_bytes > self._policy.rotate_bytes)
        ):
            self._finish_part()
        if self._part is None:
            self._part = self._begun_part()
        return self._part

    def _require_room(self) -> None:
        left_h = hours_left(self._path.parent, self._state.bytes_per_h)
        if left_h is not None and 3600.0 * left_h < ROOM_AGAIN_s:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def _finish_part(self) -> None:
        part, self._part = self._part, None
        if part is not None:
            self._finished_bytes += part.size
            part.close()

    def _begun_part(self) -> PartFile:
        """The next file, with its header; none is left where that does not fit."""
        path = next_part(self._path)
        while path.exists():
            path = next_part(path)
        begin(path, {**self._header, "started_unix_s": time.time()}, self._pwrite)
        self._path = path
        remove_oldest(path, self._policy, self._say)
        return PartFile(path, self._pwrite)

    def _lose(self, lost_bytes: int) -> None:
        lost = self._state.lost_rows + lost_bytes // self.row_bytes
        self._state = replace(self._state, lost_rows=lost)

    def _stop(self, error: OSError) -> None:
        self._retry_at_s = self._now_s() + RETRY_s
        if not self._state.is_on:
            return
        reason = error.strerror or str(error)
        self._lost_before = self._state.lost_rows
        self._state = replace(self._state, is_on=False, reason=reason, since_unix_s=time.time())
        self._say(
            f"{self._path}: recording stopped: {reason}. The arm keeps running; recording resumes when there is room"
        )

    def _go_on(self) -> None:
        if self._state.is_on:
            return
        lost = self._state.lost_rows - self._lost_before
        self._state = replace(self._state, is_on=True, reason="", since_unix_s=time.time())
        self._say(f"{self._path}: recording resumed; {lost} rows were lost")


def begin(path: Path, header: Mapping[str, object], pwrite: PWrite = os.pwrite) -> None:
    """A new recording with its header and no rows, or no file. OSError names it.

    The name is taken first, empty, and then the whole header put in its place: a reader never sees half of one.
    """
    content, at = header_bytes(header), 0
    os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644))
    beside = path.with_name(f".partial-{path.name}")
    try:
        fd = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        try:
            while at < len(content):
                at += pwrite(fd, content[at:], at)
            os.fsync(fd)
        finally:
            os.close(fd)
        beside.replace(path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        path.unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from error


def remove_oldest(current: Path, policy: Policy, say: Say) -> None:
    """Remove finished recordings of this arm in this folder, oldest first, until all fit into `keep_bytes`."""
    if not policy.keep_bytes or (named := NAME.fullmatch(current.name)) is None:
        return
    with contextlib.suppress(OSError):
        others = [
            path for path in current.parent.iterdir() if path != current and _arm_of(path) == named["arm"]
        ]
        by_age = sorted((path.stat().st_mtime, path.stat().st_size, path) for path in others)
        total = policy.rotate_bytes + sum(size for _, size, _ in by_age)
        for _, size, path in by_age:
            if total > policy.keep_bytes and _is_finished(path):
                path.unlink()
                total -= size
                say(f"{path}: removed as the oldest recording; [recording] keeps {policy.keep_bytes:g} bytes")


def _arm_of(path: Path) -> str | None:
    named = NAME.fullmatch(path.name)
    return named["arm"] if named else None


def _is_finished(path: Path) -> bool:
    """Whether no writer has it open."""
    fd = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    finally:
        os.close(fd)
    return True
