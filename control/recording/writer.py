"""The writer process: copies recorded rows from its standard input to a file, so that the loop never waits for a disk.

Started by the loop as `python -m control.recording.writer FILE`. It ends when the pipe closes, however the loop died, and has by
then written all that was sent. SIGINT is ignored: Ctrl-C reaches the whole process group, and the loop still has a
controlled stop to record.
"""

import os
import select
import signal
import sys

GATHER_S = 0.02  # how long rows may lie in the pipe: what a killed writer can lose
SYNC_BYTES = 1 << 18  # how often the kernel is asked to put the file on the disk, for power cuts


def copy(source: int, target: int) -> None:
    """Copy bytes from a pipe to a file until the pipe's other end closes."""
    unsynced = 0
    while True:
        select.select([source], [], [])
        chunk = os.read(source, 1 << 16)
        if not chunk:
            break
        while chunk:
            chunk = chunk[os.write(target, chunk) :]
        unsynced += 1 << 16
        if unsynced >= SYNC_BYTES:
            os.fdatasync(target)
            unsynced = 0
        select.select([], [], [], GATHER_S)
    os.fsync(target)


def main() -> None:
    """Copy standard input to the file named by the first argument, which must not exist."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    target = os.open(sys.argv[1], os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
    copy(sys.stdin.fileno(), target)


if __name__ == "__main__":
    main()
