"""Requests real-time scheduling from the operating system, and reports what was granted; the timer of cycles.

The loop's process uses a real-time class, locked memory and no garbage collection. None of it is required: without the
rights the loop still runs and reports what is missing, so that the operator can decide whether to run an arm.
"""

import contextlib
import ctypes
import gc
import math
import os
import re
import resource
from collections.abc import Iterator
from pathlib import Path

from control.loop.cell import Looped
from firmware_iface.clock import Clock

FIFO_PRIORITY = 80  # above what a desktop gives anything else, below the kernel's own threads (99)
MCL_FUTURE = 2
MAPS = Path("/proc/self/maps")
M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4  # of mallopt
ALGEBRA = re.compile(r"/lib[^/]*(openblas|gfortran|quadmath)[^/]*$")
LARGE_bytes = 16 << 20  # a buffer of linear algebra has 32 MB; Python's own blocks have 1 MB
LATENCY_FILE = Path("/dev/cpu_dma_latency")
COLLECT_EVERY_S = 1.0
MOST_YOUNG = 5_000  # objects: to look at as many takes a third of a cycle at 500 Hz
ISOLATED_FILE = Path("/sys/devices/system/cpu/isolated")
LIMITS = "in /etc/security/limits.d give the operator 'rtprio 90' and 'memlock unlimited', then log in again"


def request_punctuality() -> str:
    """Ask for SCHED_FIFO, locked memory, an isolated processor and no sleep states, and freeze the garbage collector.

    Returns the remedy for what was not granted; empty if everything was. Never raises.
    """
    is_locked = _lock_memory()
    gc.collect()
    gc.freeze()
    gc.disable()
    _go_to(isolated_cpus(ISOLATED_FILE))
    _keep_awake(LATENCY_FILE)
    return _remedy(_ask_fifo(), is_locked)


class Collector:
    """Frees what nothing but the collector can, where the arm stands and nothing is due.

    The loop is to leave nothing: this is a belt beside the braces. What was there at the start is frozen: never looked at again.
    """

    def __init__(self) -> None:
        self._next_s = -math.inf

    def look(self, now_s: float, runtime: Looped) -> bool:
        """Collect once a second. Whether that may have taken longer than a cycle, as it may only while all drives are off."""
        if now_s < self._next_s or not runtime.stands():
            return False
        self._next_s = now_s + COLLECT_EVERY_S
        takes_long = gc.get_count()[0] > MOST_YOUNG
        if takes_long and not runtime.is_off():
            return False
        gc.collect()
        return takes_long


def strain() -> tuple[int, int]:
    """Page faults (without and with the disk) and involuntary context switches of this thread so far."""
    used = resource.getrusage(resource.RUSAGE_THREAD)
    return used.ru_minflt + used.ru_majflt, used.ru_nivcsw


def isolated_cpus(file: Path) -> set[int]:
    """The processors that the kernel keeps free of other programs (boot option isolcpus=); usually none."""
    try:
        text = file.read_text().strip()
    except OSError:
        return set()
    spans = [part.split("-") for part in text.split(",") if part]
    return {cpu for span in spans for cpu in range(int(span[0]), int(span[-1]) + 1)}


def _lock_memory() -> bool:
    """Lock what there is, and what comes if that is unlimited; freed memory is kept, so that no page is faulted in again.

    What no cycle touches stays out of memory: numpy's linear algebra, and its buffers as large as that.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if hasattr(libc, "mallopt"):
        libc.mallopt(M_TRIM_THRESHOLD, -1)
        libc.mallopt(M_MMAP_MAX, 0)
    # With a small limit every later allocation would fail.
    is_unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    if is_unlimited and libc.mlockall(MCL_FUTURE) != 0:
        return False
    needed = needed_in_memory(MAPS.read_text())
    return all(libc.mlock(ctypes.c_void_p(at), ctypes.c_size_t(size)) == 0 for at, size in needed)


def needed_in_memory(maps: str) -> Iterator[tuple[int, int]]:
    """Start and size of what a cycle may touch, from the text of /proc/PID/maps.

    Left out are the kernel's own, what may not be read, and linear algebra with its buffers.
    """
    for line in maps.splitlines():
        span, rights, *others = line.split(maxsplit=5)
        name = others[3] if len(others) > 3 else ""
        if rights[0] == "r" and not name.startswith("[v"):
            start, end = (int(part, 16) for part in span.split("-"))
            if not ALGEBRA.search(name) and (name or end - start < LARGE_bytes):
                yield start, end - start


def _go_to(cpus: set[int]) -> None:
    """Run on the last of these processors, if there are any."""
    if cpus:
        with contextlib.suppress(OSError):
            os.sched_setaffinity(0, {max(cpus)})


def _keep_awake(file: Path) -> None:
    """Ask for processors that wake up at once, for as long as this process runs: the kernel counts the open file."""
    with contextlib.suppress(OSError):
        fd = os.open(file, os.O_WRONLY | os.O_CLOEXEC)
        os.write(fd, bytes(4))  # 0 us


def punctuality_remedy() -> str:
    """The return value of `request_punctuality`, without a lasting change."""
    is_root = os.geteuid() == 0
    has_priority = is_root or resource.getrlimit(resource.RLIMIT_RTPRIO)[1] >= FIFO_PRIORITY
    has_memory = is_root or resource.getrlimit(resource.RLIMIT_MEMLOCK)[1] == resource.RLIM_INFINITY
    return _remedy(has_priority, has_memory)


def _remedy(is_fifo: bool, is_locked: bool) -> str:
    rights = {"rtprio (SCHED_FIFO)": is_fifo, "memlock (locked pages)": is_locked}
    missing = [name for name, is_granted in rights.items() if not is_granted]
    return f"no permission for {' and '.join(missing)}: cycles will be late under load; {LIMITS}" if missing else ""


def _ask_fifo() -> bool:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
    except OSError:
        return False
    return True


# The cycle timer: absolute deadlines, with a count of those missed.
#
# A deadline is the last one plus the period, never "now plus the period", so lateness does not accumulate; after a pause the
# missed deadlines are skipped, not made up in a burst, because a burst of old set-points is worse than a gap. So is one that is
# due within half a period after a pause: counts of boards that are timed by their arrival would look too fast.


class PeriodicTimer:
    """Deadlines every `period_s` on a clock.

    `wait` sets `skipped` (deadlines that passed unserved just now), `missed_in_row` and `missed` (all of them). `trim_s` makes
    each period that much longer: see control.server.process.
    """

    def __init__(self, clock: Clock, period_s: float) -> None:
        self.period_s = period_s
        self.trim_s = 0.0
        self.skipped = 0
        self.missed = 0
        self.missed_in_row = 0
        self._clock = clock
        self._deadline_s = clock.now_s() + period_s

    def wait(self) -> float:
        """Wait for the next deadline; returns the lateness at the start of the cycle in s."""
        self._clock.wait_until_s(self._deadline_s)
        late_s = self._clock.now_s() - self._deadline_s
        periods = late_s / self.period_s
        self.skipped = int(periods + (0.499 if periods >= 1.0 else 0.0))  # 0.499: rounding errors skip nothing
        self.missed += self.skipped
        self.missed_in_row = self.missed_in_row + self.skipped if self.skipped else 0
        self._deadline_s += (self.skipped + 1) * self.period_s + self.trim_s
        return late_s

    def restart(self) -> None:
        """Restart one period from now, after a wait outside of a cycle that must not count as lateness."""
        self._deadline_s = self._clock.now_s() + self.period_s
