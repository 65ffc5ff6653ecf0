"""The printer: copies lines from its standard input to its standard output, so that the loop never waits for a terminal.

Started by the loop as `python -m control.server.printer`. A terminal that was stopped with Ctrl-S stops this process alone;
lines that the pipe cannot take meanwhile are lost. It ends when the pipe closes.
"""

import contextlib
import os
import signal
import subprocess

from firmware_iface.installation import command

END_LIMIT_S = 2.0  # for the last lines; a stopped terminal does not keep the runtime from ending


class Printer:
    """Prints lines by way of a process of its own; `say` never waits."""

    def __init__(self) -> None:
        read_fd, self._fd = os.pipe()
        self._process = subprocess.Popen(
            command("control.server.printer"), stdin=read_fd, start_new_session=True
        )
        os.close(read_fd)
        os.set_blocking(self._fd, False)

    def say(self, text: str) -> None:
        """Print one line; lost where the pipe is full or nobody reads."""
        with contextlib.suppress(BlockingIOError, BrokenPipeError):
            os.write(self._fd, text.encode(errors="replace"))

    def close(self) -> None:
        """Print what was said and end."""
        os.close(self._fd)
        try:
            self._process.wait(END_LIMIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def main() -> None:
    """Copy until the pipe closes, or until nobody reads."""
    for number in (signal.SIGINT, signal.SIGTERM):  # the loop still has its shutdown to say
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(BrokenPipeError, OSError):
        while chunk := os.read(0, 1 << 16):
            while chunk:
                chunk = chunk[os.write(1, chunk) :]


if __name__ == "__main__":
    main()
