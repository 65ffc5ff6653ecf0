"""A subcommand in a separate process that ends with the console.

Its motion ends with its connection, so a killed console leaves no moving arm.
"""

import asyncio
import signal
from collections.abc import Sequence

from firmware_iface.installation import command
from procedures.child_process import ends_with_parent


async def subcommand(words: Sequence[str], takes_answers: bool = False) -> asyncio.subprocess.Process:
    """Start `armwright WORDS` with piped stdout. OSError if the process cannot be started."""
    return await asyncio.create_subprocess_exec(
        *command("console.main", *words),
        stdin=asyncio.subprocess.PIPE if takes_answers else asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        start_new_session=True,  # the terminal's Ctrl-C is the console's
        preexec_fn=ends_with_parent(signal.SIGINT),
    )
