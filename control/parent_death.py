"""Ends a child process when its parent dies (Linux; elsewhere only if the parent is dead already)."""

import ctypes
import os
import signal
import sys
from collections.abc import Callable

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def signal_on_death_of(parent: int, number: signal.Signals) -> Callable[[], None]:
    """What the child has to call: it then gets signal `number` when the thread of `parent` that started it ends."""
    libc = ctypes.CDLL(None) if sys.platform == "linux" else None  # loaded here: not safe after a fork

    def in_child() -> None:
        if libc is not None:
            libc.prctl(_PR_SET_PDEATHSIG, number)
        if os.getppid() != parent:  # it died before the request
            os.kill(os.getpid(), number)

    return in_child
