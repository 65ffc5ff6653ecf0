"""Child processes that never outlive the console or demo that started them.

A script's background job starts with SIGINT ignored, nohup's with SIGHUP, and exec inherits that: a child would ignore the
signal that should end it.
"""

import os
import signal
from collections.abc import Callable

from control.parent_death import signal_on_death_of

_HEARD = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def ends_with_parent(number: signal.Signals) -> Callable[[], None]:
    """A `preexec_fn`: default signal handling, and the child gets signal `number` when this process dies."""
    hear_death = signal_on_death_of(os.getpid(), number)

    def before_exec() -> None:
        for handled in _HEARD:
            signal.signal(handled, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _HEARD)
        hear_death()

    return before_exec
