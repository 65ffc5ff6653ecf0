"""Child processes that never outlive the console or demo that started them.

A script's background job starts with SIGINT ignored, nohup's with SIGHUP, and exec inherits that: a child would ignore the
signal that should end it. SIGINT and SIGTERM wait until the child hears them (`firmware_iface/interrupts.py`).
"""

import os
import signal
from collections.abc import Callable

from control.parent_death import signal_on_death_of
from firmware_iface.interrupts import NUMBERS


def ends_with_parent(number: signal.Signals) -> Callable[[], None]:
    """A `preexec_fn` for a `command`: no signal is ignored, and the child gets signal `number` when this process dies."""
    hear_death = signal_on_death_of(os.getpid(), number)

    def before_exec() -> None:
        for handled in (*NUMBERS, signal.SIGHUP):
            signal.signal(handled, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_SETMASK, NUMBERS)
        hear_death()

    return before_exec
