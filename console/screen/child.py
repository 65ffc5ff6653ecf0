"""A subcommand in a process of its own that does not outlive the console: where the console dies, so do its lines.

Its motion ends with its connection, so whatever kills the console leaves no arm moving for it.
"""

import asyncio
import ctypes
import os
import signal
import sys
from collections.abc import Sequence

from firmware_iface.installation import command

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


async def subcommand(words: Sequence[str], takes_answers: bool = False) -> asyncio.subprocess.Process:
    """Start `armwright WORDS`; what it says comes from its stdout. OSError where there can be no process."""
    console = os.getpid()

    def die_with_console() -> None:
        """In the child: Ctrl-C when the console is gone, also where that was before this was said."""
        if sys.platform == "linux":
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGINT)
        if os.getppid() != console:
            os.kill(os.getpid(), signal.SIGINT)

    return await asyncio.create_subprocess_exec(
        *command("console.main", *words),
        stdin=asyncio.subprocess.PIPE if takes_answers else asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        start_new_session=True,  # the terminal's Ctrl-C is the console's
        preexec_fn=die_with_console,
    )
