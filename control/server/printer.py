"""The printer: copies lines from its standard input to its standard output, so that the loop never waits for a terminal.

Started by the loop as `python -m control.server.printer`. A terminal that was stopped with Ctrl-S stops only this process;
lines that the pipe cannot take meanwhile are lost. It ends when the pipe closes. Lines are UTF-8 in the pipe, and in the
encoding of the standard output behind it (control.plain_text).
"""

import codecs
import contextlib
import os
import signal
import subprocess
import sys

from control.plain_text import HANDLER, prepare_streams
from firmware_iface.installation import command
from firmware_iface.interrupts import held

END_LIMIT_S = 2.0  # for the last lines; a stopped terminal must not keep the runtime from ending


class Printer:
    """Prints lines through a separate process; `say` never blocks."""

    def __init__(self) -> None:
        read_fd, self._fd = os.pipe()
        with held():
            self._process = subprocess.Popen(command("control.server.printer"), stdin=read_fd, start_new_session=True)
        os.close(read_fd)
        os.set_blocking(self._fd, False)

    def say(self, text: str) -> None:
        """Print one line; it is lost if the pipe is full or nobody reads."""
        with contextlib.suppress(BlockingIOError, BrokenPipeError):
            os.write(self._fd, text.encode(errors="replace"))

    def close(self) -> None:
        """Print the remaining lines and end."""
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
    prepare_streams()
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"  # None: the standard output is closed
    decoder = codecs.getincrementaldecoder("utf-8")("replace")
    with contextlib.suppress(OSError):
        while chunk := os.read(0, 1 << 16):
            text = decoder.decode(chunk).encode(encoding, HANDLER)
            while text:
                text = text[os.write(1, text) :]


if __name__ == "__main__":
    main()
