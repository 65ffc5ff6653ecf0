"""The writer process: copies rows from its standard input to files, so that the loop never waits for a disk.

Started by the loop as `python -m control.recording.writer FILE ROTATE_BYTES KEEP_BYTES`; FILE has its header. The writer ends
when the pipe closes, however the loop ended, after writing all that was sent. It reports the recording's state on its
standard output, a JSON object a message (control.recording.recorder_state). It ignores SIGINT: Ctrl-C reaches the whole process
group, and the loop still has a controlled stop to record.

The process forks: the child writes, and the parent only waits. If the child is killed, the parent starts another one, which
continues in a new file. Rows stay in the pipe meanwhile, because the parent holds its end open.
"""

import contextlib
import json
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from control.recording.reading import Recording
from control.recording.recorder_state import RecorderState, has_part, last_part
from control.recording.rotation import Policy, RecordingParts, begin_next

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
