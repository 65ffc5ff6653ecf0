"""The writer process: copies rows from its standard input to files, so that the loop never waits for a disk.

Started by the loop as `python -m control.recording.writer FILE ROTATE_BYTES KEEP_BYTES`; FILE has its header. The writer ends
when the pipe closes, however the loop ended, after writing all that was sent. It reports the recording's state on its
standard output, a JSON object a message (control.recording.recorder_state). It ignores SIGINT: Ctrl-C reaches the whole process
group, and the loop still has a controlled stop to record.

The process forks: the child writes, and the parent only waits. If the child is killed, the parent starts another one, which
continues in a new file. Rows stay in the pipe meanwhile, because the parent holds its end open.

A new file begins at a size limit, each readable on its own; the oldest are removed beyond a total size. A full disk loses rows,
but does not end the recording: writing is retried every second. A file always ends with a complete row, and a gap shows in the
rows' times and cycle numbers.
"""

import contextlib
import errno
import fcntl
import json
import os
import re
import select
import signal
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from control.files import make_whole
from control.recording.frames import FrameEncoder, in_frames
from control.recording.reading import RecordError, Recording
from control.recording.record import header_bytes
from control.recording.recorder_state import RecorderState, has_part, hours_left, last_part, next_part

RETRY_s = 1.0
SYNC_bytes = 1 << 18  # interval of fsync, for power cuts
FRAMED_SHARE = 0.2  # of a packed row that a row in frames takes, before it is measured
MEASURED_ROWS = 5000
ROOM_AGAIN_s = 60.0  # of rows that must fit before a stopped recording resumes
RUN_OF_CELL = re.compile(r"(?P<cell>.+)-\d{8}-\d{6}(-\d+)?")  # a folder: control.recording.cell_folder
NAME = re.compile(r"(?P<arm>.+)-\d{8}-\d{6}(-\d+)?(\.part\d+)?\.armlog")
PWrite = Callable[[int, bytes, int], int]
Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Policy:
    """Size at which a new file begins, and total size of all files of an arm (0: no limit)."""

    rotate_bytes: int
    keep_bytes: int = 0


class PartFile:
    """A file of a recording, with its header; grows by complete rows or frames only. `pwrite` writes to the disk."""

    def __init__(self, path: Path, pwrite: PWrite = os.pwrite) -> None:
        opened = Recording.open(path)
        self.path, self.header, self.row_bytes = path, opened.header, opened.layout.packing.size
        self._rows_at, self._pwrite, self._unsynced = opened.offset, pwrite, 0
        self.row_count, self.size = opened.extent()
        self._encoder = FrameEncoder(opened.columns, opened.layout.packing) if opened.columns else None
        # Appending, so that a file which was emptied by somebody else gets no hole.
        self._fd = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW)
        with contextlib.suppress(OSError):  # marks the file as unfinished for other runtimes
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def harm(self) -> tuple[str, int]:
        """What another program has done to the file since, in words (empty: nothing), and how many rows that took."""
        state = os.fstat(self._fd)
        if state.st_nlink == 0:
            return "removed", self.row_count
        if state.st_size != self.size:
            if state.st_size > self.size:
                os.ftruncate(self._fd, self.size)
            return "emptied, cut or written to", self._mended()
        with contextlib.suppress(OSError):
            if os.path.samestat(state, self.path.stat()):
                return "", 0
        return "moved away", 0

    def _mended(self) -> int:
        """Leave a file that can be read; how many of its rows are gone."""
        try:
            return max(0, self.row_count - Recording.open(Path(f"/proc/self/fd/{self._fd}")).row_count)
        except (RecordError, OSError):  # not even its header is left
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, 0)
                self._pwrite(self._fd, header_bytes(self.header), 0)
            return self.row_count

    @property
    def has_rows(self) -> bool:
        """Whether there is anything but the header."""
        return self.row_count > 0

    @property
    def rows_bytes(self) -> int:
        """What all rows take."""
        return self.size - self._rows_at

    def append(self, rows: bytes) -> None:
        """Write complete rows. OSError if not all of them fit: rows or frames that fit are kept, none is truncated."""
        if self._encoder is None:
            self._write(rows, self.row_bytes, 1)
            return
        try:
            for portion in in_frames(rows, self.row_bytes):
                frame = self._encoder.frame(portion)
                self._write(frame, len(frame), len(portion) // self.row_bytes)
        except OSError:
            self._encoder.restart()
            raise

    def _write(self, content: bytes, unit_bytes: int, unit_rows: int) -> None:
        """Append units of so many bytes and rows; OSError if not all fit, and then only whole units are kept."""
        at, rest = self.size, content
        try:
            while rest:
                written = self._pwrite(self._fd, rest, at)
                at, rest = at + written, rest[written:]
        finally:
            self._unsynced += at - self.size
            units = (at - self.size) // unit_bytes
            self.size += units * unit_bytes
            self.row_count += units * unit_rows
            if at != self.size:
                with contextlib.suppress(OSError):
                    os.ftruncate(self._fd, self.size)

    def synchronise(self, least_bytes: int = 1) -> None:
        """Sync to the disk if enough was written since the last time."""
        if self._unsynced >= least_bytes:
            self._unsynced = 0
            os.fdatasync(self._fd)

    def close(self) -> None:
        """Sync and close."""
        try:
            self.synchronise()
        finally:
            os.close(self._fd)


class RecordingParts:
    """Appends rows to the recording `first`, which already has its header, and to its later parts.

    `say` is called once when rows are lost and once when recording resumes. `now_s` times the retries.
    """

    def __init__(
        self, first: Path, policy: Policy, say: Say, pwrite: PWrite = os.pwrite, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._policy, self._say, self._pwrite, self._now_s = policy, say, pwrite, now_s
        part = PartFile(first, pwrite)
        self._part: PartFile | None = part
        self._path, self._header, self.row_bytes = first, part.header, part.row_bytes
        self._finished_bytes, self._retry_at_s, self._lost_before = 0, 0.0, 0
        self._rows_per_h = 3600.0 / float(part.header.get("period_s") or 1.0)
        rate = self._rows_per_h * stored_row_bytes(part.row_bytes, "frames" in part.header)
        self._state = RecorderState(True, str(first), since_unix_s=time.time(), bytes_per_h=rate)
        remove_oldest(first, policy, say)

    def append(self, rows: bytes) -> None:
        """Write complete rows, and count those that the disk did not accept."""
        if not self._state.is_on and self._now_s() < self._retry_at_s:
            self._lose(len(rows) // self.row_bytes)
            return
        recorded = 0
        try:
            part = self._prepared(len(rows))
            begun = part.row_count
            try:
                part.append(rows)
            finally:
                recorded = part.row_count - begun
            part.synchronise(SYNC_bytes if self._state.is_on else 1)
        except OSError as error:
            self._stop(error)
        else:
            self._go_on()
        self._lose(len(rows) // self.row_bytes - recorded)

    def state(self) -> RecorderState:
        """The present state of the recording."""
        part = self._part
        if part is not None and part.row_count >= MEASURED_ROWS:
            rate = self._rows_per_h * part.rows_bytes / part.row_count
            self._state = replace(self._state, bytes_per_h=rate)
        size = part.size if part is not None else 0
        left = hours_left(self._path.parent, self._state.bytes_per_h)
        return replace(self._state, file=str(self._path), written_bytes=self._finished_bytes + size, hours_left=left)

    def close(self) -> None:
        """Sync everything and close."""
        try:
            self._finish_part()
        except OSError as error:
            self._stop(error)
        if not self._state.is_on:
            self._say(f"{self._path}: the recording ends with {self._state.lost_rows} rows lost")

    def _prepared(self, more_bytes: int) -> PartFile:
        """The part that has room for `more_bytes`; OSError if there is none."""
        if not self._state.is_on:
            self._require_room()
        part = self._part
        if part is not None:
            harm, gone = part.harm()
            if harm:
                self._lose(gone)
                lost = f", and {gone} cycles with it" if gone else ""
                self._say(f"{part.path}: {harm} by another program{lost}; recording continues in another file")
            if harm or (part.has_rows and part.size + more_bytes > self._policy.rotate_bytes):
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
        """Create the next file with its header; it is removed again if the header does not fit."""
        self._path = begin_next(self._path, self._header, self._pwrite)
        remove_oldest(self._path, self._policy, self._say)
        return PartFile(self._path, self._pwrite)

    def _lose(self, rows: int) -> None:
        self._state = replace(self._state, lost_rows=self._state.lost_rows + rows)

    def _stop(self, error: OSError) -> None:
        self._retry_at_s = self._now_s() + RETRY_s
        if not self._state.is_on:
            return
        reason = error.strerror or str(error)
        self._lost_before = self._state.lost_rows
        self._state = replace(self._state, is_on=False, reason=reason, since_unix_s=time.time())
        self._say(f"{self._path}: recording stopped: {reason}. The arm keeps running; recording resumes when there is room")

    def _go_on(self) -> None:
        if self._state.is_on:
            return
        lost = self._state.lost_rows - self._lost_before
        self._state = replace(self._state, is_on=True, reason="", since_unix_s=time.time())
        self._say(f"{self._path}: recording resumed; {lost} rows were lost")


def stored_row_bytes(packed_bytes: int, is_framed: bool = True) -> float:
    """What a row is expected to take in its file."""
    return packed_bytes * (FRAMED_SHARE if is_framed else 1.0)


def begin(path: Path, header: Mapping[str, object], pwrite: PWrite = os.pwrite) -> None:
    """Create a recording with its complete header and no rows; on OSError there is no file."""
    content = header_bytes(header)

    def write(apart: Path) -> None:
        with apart.open("xb") as file:
            at = 0
            while at < len(content):
                at += pwrite(file.fileno(), content[at:], at)

    make_whole(path, write, is_new=True)


def begin_next(path: Path, header: Mapping[str, object], pwrite: PWrite = os.pwrite) -> Path:
    """Create the first free file after `path` in which its recording continues; errors as `begin`."""
    path = next_part(path)
    while path.exists():
        path = next_part(path)
    begin(path, {**header, "started_unix_s": time.time()}, pwrite)
    return path


def remove_oldest(current: Path, policy: Policy, say: Say) -> None:
    """Remove finished recordings of this arm, oldest first, until all fit into `keep_bytes`.

    Those in its folder; of an arm of a cell, in the folders of all runs of that cell.
    """
    if not policy.keep_bytes or (named := NAME.fullmatch(current.name)) is None:
        return
    with contextlib.suppress(OSError):
        others = [
            path for folder in _folders(current) for path in folder.iterdir() if path != current and _arm_of(path) == named["arm"]
        ]
        by_age = sorted((path.stat().st_mtime, path.stat().st_size, path) for path in others)
        total = policy.rotate_bytes + sum(size for _, size, _ in by_age)
        for _, size, path in by_age:
            if total > policy.keep_bytes and _is_finished(path):
                path.unlink()
                total -= size
                if path.parent != current.parent:
                    with contextlib.suppress(OSError):  # other arms' files are in it
                        path.parent.rmdir()
                say(f"{path}: removed as the oldest recording; [recording] keeps {1e-6 * policy.keep_bytes:g} MB")


def _folders(current: Path) -> list[Path]:
    """Where the arm's recordings are."""
    here = current.parent
    if (named := RUN_OF_CELL.fullmatch(here.name)) is None:
        return [here]
    same = (folder for folder in here.parent.iterdir() if folder.is_dir())
    return [one for one in same if (other := RUN_OF_CELL.fullmatch(one.name)) and other["cell"] == named["cell"]]


def _arm_of(path: Path) -> str | None:
    named = NAME.fullmatch(path.name)
    return named["arm"] if named else None


def _is_finished(path: Path) -> bool:
    """Whether no writer has the file open."""
    fd = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    finally:
        os.close(fd)
    return True


GATHER_s = 0.02  # longest time that rows wait in the pipe; a killed writer loses no more
REPORT_s = 0.5
CHUNK_bytes = 1 << 16
RESTART_s = 0.1  # pause before a killed writer is replaced, in case the next one is killed, too


def copy(source: int, parts: RecordingParts, row_bytes: int, report: Callable[[RecorderState], None]) -> None:
    """Copy rows from a pipe until its other end closes; an incomplete last row is dropped."""
    rest, report_at_s, was_on = b"", 0.0, True
    while True:
        is_readable, _, _ = select.select([source], [], [], REPORT_s)
        if is_readable:
            # Only whole rows are taken from the pipe, so that another writer can continue with the next one.
            if not (chunk := os.read(source, CHUNK_bytes // row_bytes * row_bytes)):
                break
            whole = (len(rest) + len(chunk)) // row_bytes * row_bytes
            rows = rest + chunk
            parts.append(rows[:whole])
            rest = rows[whole:]
        state = parts.state()
        if time.monotonic() >= report_at_s or state.is_on != was_on:
            report_at_s, was_on = time.monotonic() + REPORT_s, state.is_on
            report(state)
        select.select([], [], [], GATHER_s)


def main() -> None:
    """Append standard input to the recording named by the arguments."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    first, rotate_bytes, keep_bytes = sys.argv[1:]
    os.set_blocking(sys.stdout.fileno(), False)  # never wait for a loop that does not read the reports
    path = _supervised(Path(first))
    parts = RecordingParts(path, Policy(int(rotate_bytes), int(keep_bytes)), _say)
    copy(sys.stdin.fileno(), parts, parts.row_bytes, _report)
    parts.close()


def _supervised(first: Path) -> Path:
    """Fork a writer, and another one after each that a signal kills; returns only in the writer, with its file."""
    path, header = first, Recording.open(first).header
    while os.fork():
        _, status = os.wait()
        if not os.WIFSIGNALED(status):
            sys.exit(os.waitstatus_to_exitcode(status))
        time.sleep(RESTART_s)
        killed, path = path, _continued(first, header)
        _say(f"{killed}: the writer was killed (signal {os.WTERMSIG(status)}); recording continues in {path}")
    return path


def _continued(first: Path, header: Mapping[str, object]) -> Path:
    """The file for a new writer: the latest one if it has no rows yet, else the next one."""
    path = last_part(first)
    if path.exists() and not has_part(path):  # the writer was killed while it created this file
        path.unlink()
        path = last_part(first)
    if path.exists() and not Recording.open(path).row_count:
        return path
    try:
        return begin_next(path, header)
    except OSError as error:
        _say(f"{error.filename}: recording has ended: the writer was killed, and {error.strerror}")
        sys.exit(1)


def _report(state: RecorderState) -> None:
    with contextlib.suppress(OSError):  # the loop does not read the reports
        os.write(sys.stdout.fileno(), json.dumps(state.content()).encode() + b"\n")


def _say(text: str) -> None:
    with contextlib.suppress(OSError):
        sys.stderr.buffer.write(f"{time.strftime('%H:%M:%S')}  {text}\n".encode("ascii", "backslashreplace"))
        sys.stderr.buffer.flush()


if __name__ == "__main__":
    main()
