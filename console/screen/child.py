"""A subcommand in a process of its own that does not outlive the console: where the console dies, so do its lines.

Its motion ends with its connection, so whatever kills the console leaves no arm moving for it.
"""

import asyncio
import signal
from collections.abc import Sequence

from firmware_iface.installation import command
from procedures.child_process import ends_with_parent


async def subcommand(words: Sequence[str], takes_answers: bool = False) -> asyncio.subprocess.Process:
    """Start `armwright WORDS`; what it says comes from its stdout. OSError where there can be no process."""
    return await asyncio.create_subprocess_exec(
        *command("console.main", *words),
        stdin=asyncio.subprocess.PIPE if takes_answers else asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        start_new_session=True,  # the terminal's Ctrl-C is the console's
        preexec_fn=ends_with_parent(signal.SIGINT),
    )
