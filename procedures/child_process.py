"""Child processes that never outlive the console or demo that started them.

A script's background job starts with SIGINT ignored, nohup's with SIGHUP, and exec inherits that: a child would ignore the
signal that should end it.
"""

import ctypes
import os
import signal
import sys
from collections.abc import Callable

_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_HEARD = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def ends_with_parent(number: signal.Signals) -> Callable[[], None]:
    """A `preexec_fn`: default signal handling, and the child gets signal `number` when this process dies."""
    parent = os.getpid()
    libc = ctypes.CDLL(None) if sys.platform == "linux" else None  # loaded here: not safe after a fork

    def before_exec() -> None:
        for handled in _HEARD:
            signal.signal(handled, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _HEARD)
        if libc is not None:
            libc.prctl(_PR_SET_PDEATHSIG, number)
        if os.getppid() != parent:  # the parent died before the request
            os.kill(os.getpid(), number)

    return before_exec
