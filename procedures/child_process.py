"""Child processes that do not outlive the console or demo that started them, whatever ended it.

A script's background job starts with SIGINT ignored, nohup's with SIGHUP, and exec hands that on: a child would ignore the
signal that is to end it.
"""

import ctypes
import os
import signal
import sys
from collections.abc import Callable

_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_HEARD = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def ends_with_parent(number: signal.Signals) -> Callable[[], None]:
    """A `preexec_fn`: signals as a program expects them, and `number` to the child when this process dies."""
    parent = os.getpid()
    libc = ctypes.CDLL(None) if sys.platform == "linux" else None  # loaded here: after a fork it may not be

    def before_exec() -> None:
        for heard in _HEARD:
            signal.signal(heard, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _HEARD)
        if libc is not None:
            libc.prctl(_PR_SET_PDEATHSIG, number)
        if os.getppid() != parent:  # it died before this was asked for
            os.kill(os.getpid(), number)

    return before_exec
