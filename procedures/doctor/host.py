"""Checks of this machine: rights, timer lateness, disk speed for recordings, ports and buses."""

import os
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from control.recording.record import Layout
from control.recording.rotation import stored_row_bytes
from control.server.process import PIPE_bytes
from control.server.scheduling import punctuality_remedy, strain
from firmware_iface.clock import Clock, MonotonicClock
from procedures.doctor.finding import Finding, Level, advised, graded, percentile

TICK_S = 0.001
PAUSE_TEST_S = 1.0
DISK_TEST_bytes = 4 << 20
BLOCK_bytes = 1 << 16
LEAST_FREE_HOURS = 2.0
GROUP = "host"
LEAST_RT_us = 900_000  # of each second, the kernel's own default is 950,000: the loop needs a fifth
CALM_SWITCHES = 50  # in a second of measuring


def look_at_host(period_s: float, watchdog_s: float, joints: int, log_folder: Path) -> list[Finding]:
    """Check rights, pauses and the disk."""
    remedy = punctuality_remedy()
    level = Level.WARN if remedy else Level.OK
    rights = Finding(
        level,
        GROUP,
        "real-time rights",
        "not granted" if remedy else "granted",
        "SCHED_FIFO, memlock",
        remedy,
    )
    before = strain()
    late_s = lateness(MonotonicClock(), PAUSE_TEST_S)
    page_faults, switches = (now - was for now, was in zip(strain(), before, strict=True))
    rate_bytes_s = stored_row_bytes(Layout.of(joints).packing.size) / period_s
    return [
        rights,
        *look_at_kernel(Path("/")),
        *judge_lateness(late_s, period_s, watchdog_s),
        judge_strain(page_faults, switches),
        *look_at_disk(log_folder, rate_bytes_s),
    ]


def look_at_kernel(root: Path) -> list[Finding]:
    """Check what the kernel under `root` does about real time: frequency governors, preemption, limits of real-time tasks."""
    governors = {
        _text(file) for file in root.glob("sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor")
    }
    slow = sorted(governors - {"performance", ""})
    is_realtime = _text(root / "sys/kernel/realtime") == "1"
    runtime_us = _text(root / "proc/sys/kernel/sched_rt_runtime_us")
    is_throttled = runtime_us not in ("-1", "")
    share = f"{int(runtime_us) / 1e4:.0f} % of each second" if is_throttled else "not throttled"
    return [
        advised(not slow, GROUP, "frequency governor", ", ".join(slow) or "performance, or none", "performance",
                 "`cpupower frequency-set -g performance`: a processor that slows down is late"),
        advised(is_realtime, GROUP, "kernel", "PREEMPT_RT" if is_realtime else "without PREEMPT_RT", "PREEMPT_RT",
                 "a kernel with PREEMPT_RT bounds the lateness of the loop; without, drivers may hold it up for milliseconds"),
        advised(not is_throttled or int(runtime_us) >= LEAST_RT_us, GROUP, "real-time tasks", share, "90 % or more",
                 "`sysctl kernel.sched_rt_runtime_us=950000`: below, the kernel stops the loop for the rest of each second"),
    ]  # fmt: skip


def judge_strain(page_faults: int, switches: int) -> Finding:
    """What took time from this process while its lateness was measured."""
    measured = f"{switches} involuntary switches, {page_faults} page faults"
    remedy = "end other programs; give the operator the rights above"
    is_calm = switches <= CALM_SWITCHES
    return advised(
        is_calm, GROUP, "what took its time meanwhile", measured, f"at most {CALM_SWITCHES} switches", remedy
    )


def _text(file: Path) -> str:
    try:
        return file.read_text().strip()
    except OSError:
        return ""


def lateness(clock: Clock, duration_s: float) -> list[float]:
    """Lateness of this process at many short deadlines [s]."""
    late_s: list[float] = []
    deadline_s = clock.now_s() + TICK_S
    end_s = deadline_s + duration_s
    while deadline_s < end_s:
        clock.wait_until_s(deadline_s)
        now_s = clock.now_s()
        late_s.append(now_s - deadline_s)
        deadline_s = max(deadline_s, now_s - now_s % TICK_S) + TICK_S
    return late_s


def judge_lateness(late_s: list[float], period_s: float, watchdog_s: float) -> list[Finding]:
    """Compare typical lateness with the period, and the longest pause with the boards' watchdog."""
    p99, longest = percentile(late_s, 0.99), max(late_s, default=float("nan"))
    remedy = "end other programs, grant the rights above, turn power saving off (`powerprofilesctl set performance`)"
    return [
        graded(
            GROUP, "timer lateness", p99, (0.5 * period_s, 5.0 * period_s),
            (f"99 % within {1e3 * p99:.2f} ms", f"below {500 * period_s:.2g} ms", remedy),
        ),
        graded(
            GROUP, "longest pause of this host", longest, (0.25 * watchdog_s, 0.9 * watchdog_s),
            (
                f"{1e3 * longest:.1f} ms in {len(late_s) * TICK_S:.1f} s",
                f"below {250 * watchdog_s:.0f} ms; the boards' watchdog trips after {1e3 * watchdog_s:.0f} ms",
                remedy + "; such a pause trips the boards' watchdog",
            ),
        ),
    ]  # fmt: skip


def look_at_disk(folder: Path, rate_bytes_s: float) -> list[Finding]:
    """Check whether the disk is fast enough for recordings, and for how long there is room."""
    place = _existing(folder)
    try:
        speed_bytes_s, stall_s = _written(place, time.perf_counter)
    except OSError as error:
        problem = f"cannot write there: {error.strerror or error}"
        remedy = "give --log a writable folder"
        return [Finding(Level.BAD, GROUP, f"recordings in {folder}", problem, "", remedy)]
    free_hours = shutil.disk_usage(place).free / rate_bytes_s / 3600.0
    room_s = PIPE_bytes / rate_bytes_s
    return [
        graded(
            GROUP, "disk speed", rate_bytes_s / speed_bytes_s, (0.2, 0.8),
            (
                f"{speed_bytes_s / 1e6:.0f} MB/s in {place}",
                f"{rate_bytes_s / 1e6:.2g} MB/s for the recording, with a margin of five",
                "record to another disk: `armwright serve --log DIR`",
            ),
        ),
        graded(
            GROUP, "longest stall of the disk", stall_s, (0.25 * room_s, room_s),
            (f"{1e3 * stall_s:.0f} ms", f"below {room_s:.1f} s, the recorder's buffer", "record to another disk"),
        ),
        graded(
            GROUP, "space for recordings", 1.0 / max(free_hours, 1e-9), (1.0 / LEAST_FREE_HOURS, 10.0),
            (f"{free_hours:.0f} hours", f"more than {LEAST_FREE_HOURS:g} hours", "free some space, or record to another disk"),
        ),
    ]  # fmt: skip


def _existing(folder: Path) -> Path:
    folder = folder.resolve()
    while not folder.is_dir() and folder != folder.parent:
        folder = folder.parent
    return folder


def _written(folder: Path, now_s: Callable[[], float]) -> tuple[float, float]:
    """Bytes per second written to the disk, and the longest time for a block."""
    block = os.urandom(BLOCK_bytes)
    longest_s = 0.0
    with tempfile.TemporaryFile(dir=folder, prefix=".armwright-doctor-") as file:
        begun_s = now_s()
        for _ in range(DISK_TEST_bytes // BLOCK_bytes):
            before_s = now_s()
            file.write(block)
            longest_s = max(longest_s, now_s() - before_s)
        file.flush()
        before_s = now_s()
        os.fsync(file.fileno())
        longest_s = max(longest_s, now_s() - before_s)
        return DISK_TEST_bytes / max(now_s() - begun_s, 1e-9), longest_s
