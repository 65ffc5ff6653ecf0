"""The writer process: copies recorded rows from its standard input to files, so that the loop never waits for a disk.

Started by the loop as `python -m control.recording.writer FILE ROTATE_BYTES KEEP_BYTES`; FILE has its header. The writer ends
when the pipe closes, however the loop died. By then it has written all that was sent. It reports the recording's state on its
standard output, a JSON object a message (control.recording.recorder_state). It ignores SIGINT: Ctrl-C reaches the whole process
group, and the loop still has a controlled stop to record.
"""

import contextlib
import json
import os
import select
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from control.recording.recorder_state import RecorderState
from control.recording.rotation import Parts, Policy

GATHER_s = 0.02  # how long rows may lie in the pipe: what a killed writer can lose
REPORT_s = 0.5
CHUNK_bytes = 1 << 16


def copy(source: int, parts: Parts, row_bytes: int, report: Callable[[RecorderState], None]) -> None:
    """Copy rows from a pipe until its other end closes; a last row that is torn is left out."""
    rest, report_at_s, was_on = b"", 0.0, True
    while True:
        is_readable, _, _ = select.select([source], [], [], REPORT_s)
        if is_readable:
            if not (chunk := os.read(source, CHUNK_bytes)):
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
    """Append standard input to the recording that the arguments name."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    first, rotate_bytes, keep_bytes = sys.argv[1:]
    os.set_blocking(sys.stdout.fileno(), False)  # a loop that does not listen must not hold up the disk
    parts = Parts(Path(first), Policy(int(rotate_bytes), int(keep_bytes)), _say)
    copy(sys.stdin.fileno(), parts, parts.row_bytes, _report)
    parts.close()


def _report(state: RecorderState) -> None:
    with contextlib.suppress(OSError):  # nobody listens, or not now
        os.write(sys.stdout.fileno(), json.dumps(state.content()).encode() + b"\n")


def _say(text: str) -> None:
    with contextlib.suppress(OSError):
        sys.stderr.buffer.write(f"armwright: {text}\n".encode("ascii", "backslashreplace"))
        sys.stderr.buffer.flush()


if __name__ == "__main__":
    main()
