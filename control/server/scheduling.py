"""Requests real-time scheduling from the operating system, and reports what was granted.

The loop's process uses a real-time class, locked memory and no garbage collection. None of it is required: without the
rights the loop still runs and reports what is missing, so that the operator can decide whether to run an arm.
"""

import ctypes
import gc
import os

FIFO_PRIORITY = 80  # above what a desktop gives anything else, below the kernel's own threads (99)
MCL_CURRENT = 1  # not MCL_FUTURE: with a small memlock limit every later allocation would fail


LIMITS = "in /etc/security/limits.d give the operator 'rtprio 90' and 'memlock unlimited', then log in again"


def request_punctuality() -> str:
    """Ask for SCHED_FIFO and locked memory, and freeze the garbage collector.

    Returns the remedy for what was not granted; empty if everything was. Never raises.
    """
    is_locked = ctypes.CDLL(None, use_errno=True).mlockall(MCL_CURRENT) == 0
    gc.collect()
    gc.freeze()
    gc.disable()
    return _remedy(_ask_fifo(), is_locked)


def punctuality_remedy() -> str:
    """The return value of `request_punctuality`, without a lasting change."""
    import resource

    is_root = os.geteuid() == 0
    has_priority = is_root or resource.getrlimit(resource.RLIMIT_RTPRIO)[1] >= FIFO_PRIORITY
    has_memory = is_root or resource.getrlimit(resource.RLIMIT_MEMLOCK)[1] == resource.RLIM_INFINITY
    return _remedy(has_priority, has_memory)


def _remedy(is_fifo: bool, is_locked: bool) -> str:
    rights = {"rtprio (SCHED_FIFO)": is_fifo, "memlock (locked pages)": is_locked}
    missing = [name for name, is_granted in rights.items() if not is_granted]
    return (
        f"no permission for {' and '.join(missing)}: cycles will be late under load; {LIMITS}"
        if missing
        else ""
    )


def _ask_fifo() -> bool:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
    except OSError:
        return False
    return True
