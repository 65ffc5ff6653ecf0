"""This machine, for `armwright doctor`: rights, timer lateness, disk, ports and buses, and how the loop kept time in the last
recording.

Nothing is opened but the disk; what the boards say is `procedures.doctor.boards`.
"""

import json
import math
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from control.errors import ArmError
from control.model.arm import Arm, CanBus
from control.model.board_kinds import KINDS
from control.recording.frame_decoder import row_type
from control.recording.reading import Recording, RowReader
from control.recording.record import Layout
from control.recording.recorder_state import SUFFIX
from control.recording.writer import stored_row_bytes
from control.server.process import PIPE_bytes
from control.server.scheduling import punctuality_remedy, strain
from firmware_iface.can_link import INTERFACES, can_buses
from firmware_iface.clock import Clock, MonotonicClock
from firmware_iface.link import FrameLink
from firmware_iface.serial_link import LATENCY_ms, PortHere, latency_file, lower_latency, serial_ports
from procedures.doctor.finding import Finding, Level, graded, percentile

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
    rights = Finding(level, GROUP, "real-time rights", "not granted" if remedy else "granted", "SCHED_FIFO, memlock", remedy)
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
    governors = {_text(file) for file in root.glob("sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor")}
    slow = sorted(governors - {"performance", ""})
    is_realtime = _text(root / "sys/kernel/realtime") == "1"
    runtime_us = _text(root / "proc/sys/kernel/sched_rt_runtime_us")
    is_throttled = runtime_us not in ("-1", "")
    share = f"{int(runtime_us) / 1e4:.0f} % of each second" if is_throttled else "not throttled"
    return [
        _advised(
            not slow,
            "frequency governor",
            ", ".join(slow) or "performance, or none",
            "performance",
            "`cpupower frequency-set -g performance`: a processor that slows down is late",
        ),
        _advised(
            is_realtime,
            "kernel",
            "PREEMPT_RT" if is_realtime else "without PREEMPT_RT",
            "PREEMPT_RT",
            "a kernel with PREEMPT_RT bounds the lateness of the loop; without, drivers may hold it up for milliseconds",
        ),
        _advised(
            not is_throttled or int(runtime_us) >= LEAST_RT_us,
            "real-time tasks",
            share,
            "90 % or more",
            "`sysctl kernel.sched_rt_runtime_us=950000`: below, the kernel stops the loop for the rest of each second",
        ),
    ]


def judge_strain(page_faults: int, switches: int) -> Finding:
    """What took time from this process while its lateness was measured."""
    measured = f"{switches} involuntary switches, {page_faults} page faults"
    remedy = "end other programs; give the operator the rights above"
    is_calm = switches <= CALM_SWITCHES
    return _advised(is_calm, "what took its time meanwhile", measured, f"at most {CALM_SWITCHES} switches", remedy)


def _advised(is_well: bool, what: str, measured: str, expected: str, remedy: str) -> Finding:
    """A finding about the host that is fine or worth a warning, never bad."""
    return Finding(Level.OK if is_well else Level.WARN, GROUP, what, measured, expected, "" if is_well else remedy)


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
            GROUP,
            "timer lateness",
            p99,
            (0.5 * period_s, 5.0 * period_s),
            (f"99 % within {1e3 * p99:.2f} ms", f"below {500 * period_s:.2g} ms", remedy),
        ),
        graded(
            GROUP,
            "longest pause of this host",
            longest,
            (0.25 * watchdog_s, 0.9 * watchdog_s),
            (
                f"{1e3 * longest:.1f} ms in {len(late_s) * TICK_S:.1f} s",
                f"below {250 * watchdog_s:.0f} ms; the boards' watchdog trips after {1e3 * watchdog_s:.0f} ms",
                remedy + "; such a pause trips the boards' watchdog",
            ),
        ),
    ]


def look_at_disk(folder: Path, rate_bytes_s: float) -> list[Finding]:
    """Check whether the disk is fast enough for recordings, and for how long there is room."""
    place = _existing(folder)
    try:
        speed_bytes_s, stall_s = _written(place, time.perf_counter)
    except OSError as error:
        problem = f"not written: {error.strerror or error}"
        remedy = "give --log a writable folder"
        return [Finding(Level.BAD, GROUP, f"recordings in {folder}", problem, "", remedy)]
    free_hours = shutil.disk_usage(place).free / rate_bytes_s / 3600.0
    room_s = PIPE_bytes / rate_bytes_s
    return [
        graded(
            GROUP,
            "disk speed",
            rate_bytes_s / speed_bytes_s,
            (0.2, 0.8),
            (
                f"{speed_bytes_s / 1e6:.0f} MB/s in {place}",
                f"{rate_bytes_s / 1e6:.2g} MB/s for the recording, with a margin of five",
                "record to another disk: `armwright serve --log DIR`",
            ),
        ),
        graded(
            GROUP,
            "longest stall of the disk",
            stall_s,
            (0.25 * room_s, room_s),
            (f"{1e3 * stall_s:.0f} ms", f"below {room_s:.1f} s, the recorder's buffer", "record to another disk"),
        ),
        graded(
            GROUP,
            "space for recordings",
            1.0 / max(free_hours, 1e-9),
            (1.0 / LEAST_FREE_HOURS, 10.0),
            (f"{free_hours:.0f} hours", f"more than {LEAST_FREE_HOURS:g} hours", "free some space, or record to another disk"),
        ),
    ]


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


PORTS = "ports"
LEAST_QUEUE = 50  # frames: a burst of set-up requests must fit
_ASK_LIMIT_S = 5.0
Details = Callable[[str], Mapping[str, Any] | None]


class CountedLink:
    """A CAN bus that counts its frames, to measure the true load."""

    def __init__(self, link: FrameLink) -> None:
        self.name = link.name
        self.frames = 0
        self._link = link

    def send(self, can_id: int, payload: bytes) -> None:
        """Send one frame."""
        self.frames += 1
        self._link.send(can_id, payload)

    def receive(self) -> list[tuple[int, bytes]]:
        """Return all frames received."""
        frames = self._link.receive()
        self.frames += len(frames)
        return frames

    def close(self) -> None:
        """Leave the bus."""
        self._link.close()


def look_at_ports() -> list[Finding]:
    """List ports and buses of this host; nothing is opened."""
    ports = []
    for port in serial_ports():
        known = [said for said in (port.description, port.stable) if said]
        ports.append(f"{port.path} ({', '.join(known)})" if known else port.path)
    buses = [f"{interface}:{channel}" for interface, channel in can_buses()]
    return [
        Finding(Level.OK, PORTS, "serial ports here", ", ".join(ports) or "none"),
        Finding(Level.OK, PORTS, "CAN adapters here", ", ".join(buses) or "none known to the system"),
    ]


def look_at_links(arm: Arm) -> list[Finding]:
    """Check the serial ports and the CAN interface that arm.toml names; nothing is opened."""
    ports = {board.port: f'encoder board "{board.name}"' for board in arm.encoder_boards}
    ports |= {board.port: f'board "{board.name}"' for board in arm.boards if board.port}
    here = serial_ports()
    findings = [found for path, what in ports.items() for found in judge_serial(what, path, here, Path("/"))]
    if arm.can is not None:
        if arm.can.interface == "slcan":
            findings += judge_serial("CAN bus", arm.can.channel, here, Path("/"))
        needs_fd = any(KINDS[board.kind].needs_fd for board in arm.boards)
        findings += judge_can(arm.can, kernel_details, needs_fd)
    return findings


def judge_serial(what: str, path: str, here: list[PortHere], root: Path) -> Iterator[Finding]:
    """Whether a port has a name that stays, and whether its adapter hands bytes over at once."""
    stable = next((port.stable for port in here if port.path == path), "")
    if stable:
        yield Finding(
            Level.WARN,
            PORTS,
            f"{what}: name of its port",
            path,
            "a name that stays",
            f'the system may number ports anew: write port = "{stable}" in arm.toml',
        )
    lower_latency(path, root)
    if (file := latency_file(path, root)) is not None:
        latency_ms = file.read_text().strip()
        is_low = latency_ms == LATENCY_ms
        remedy = (
            f"this user may not set it: `echo {LATENCY_ms} | sudo tee {file}`, or for good with the udev rule in"
            " control/server/system/99-armwright.rules"
        )
        yield Finding(
            Level.OK if is_low else Level.WARN,
            PORTS,
            f"{what}: latency timer of its adapter",
            f"{latency_ms} ms",
            f"{LATENCY_ms} ms",
            "" if is_low else remedy,
        )


def judge_can(can: CanBus, details: Details, needs_fd: bool = False) -> Iterator[Finding]:
    """Whether the interface is known and its driver here; on SocketCAN, its state, bit rate and settings."""
    what = f"CAN interface {can.interface}:{can.channel}"
    known = INTERFACES.get(can.interface)
    if known is None:
        return  # one that nobody has described here; opening it says the rest
    if missing := known.missing():
        yield Finding(Level.BAD, PORTS, what, "its Python package is missing", known.package, missing)
    elif can.interface == "gs_usb":
        yield Finding(Level.WARN, PORTS, what, "waits 1 ms in each cycle", "SocketCAN", known.remedy)
    elif can.interface == "socketcan":
        yield from _judge_socketcan(what, can, details(can.channel), needs_fd)


def _judge_socketcan(what: str, can: CanBus, details: Mapping[str, Any] | None, needs_fd: bool) -> Iterator[Finding]:
    """`details` is what `ip -details -json link show` says of it; None where the machine has no such interface or no ip."""
    data_phase = "dbitrate 5000000 fd on " if needs_fd else ""
    up = f"ip link set {can.channel} up type can bitrate {can.bitrate} {data_phase}restart-ms 100"
    if details is None:
        remedy = f"plug the adapter in; `ip -br link show type can` lists what is here; then `{up}`"
        yield Finding(Level.BAD, PORTS, what, "there is no such interface", can.channel, remedy)
        return
    data = details.get("linkinfo", {}).get("info_data", {})
    state, bitrate = str(data.get("state", "")), data.get("bittiming", {}).get("bitrate")
    is_up = "UP" in details.get("flags", ["UP"])
    measured = ", ".join(part for part in ("up" if is_up else "down", state.lower()) if part)
    again = f"`ip link set {can.channel} down`, then `{up}`"
    if not is_up or state in ("BUS-OFF", "STOPPED"):
        yield Finding(Level.BAD, PORTS, what, measured, "up, error-active", again)
    elif state in ("ERROR-PASSIVE", "ERROR-WARNING"):
        remedy = "frames fail: check termination (120 ohm at both ends), wiring, supply of the boards, bit rate"
        yield Finding(Level.WARN, PORTS, what, measured, "error-active", remedy)
    else:
        yield Finding(Level.OK, PORTS, what, measured)
    if bitrate is not None and bitrate != can.bitrate:
        yield Finding(Level.BAD, PORTS, f"{what}: bit rate", str(bitrate), str(can.bitrate), again)
    if needs_fd and data and "FD" not in data.get("ctrlmode", []):
        yield Finding(Level.BAD, PORTS, f"{what}: CAN FD", "off", "on, for boards of this arm", again)
    if data and not data.get("restart_ms"):
        remedy = f"it stays off the bus after a short circuit: {again}"
        yield Finding(Level.WARN, PORTS, f"{what}: restart after bus-off", "never", "100 ms", remedy)
    if (queue := int(details.get("txqlen", LEAST_QUEUE))) < LEAST_QUEUE:
        remedy = f"`ip link set {can.channel} txqueuelen 100`"
        yield Finding(Level.WARN, PORTS, f"{what}: transmit queue", f"{queue} frames", f"{LEAST_QUEUE}", remedy)


def kernel_details(channel: str) -> Mapping[str, Any] | None:
    """What `ip` says of a network interface; None if there is no such interface. Needs no rights."""
    if not Path("/sys/class/net", channel).exists():
        return None
    try:
        output = subprocess.run(
            ["ip", "-details", "-json", "link", "show", channel], capture_output=True, text=True, timeout=_ASK_LIMIT_S, check=True
        ).stdout
        entries = json.loads(output)
    except (OSError, subprocess.SubprocessError, ValueError):
        return {}
    return entries[0] if entries else {}


LAST_RECORDING = "last recording"
AGE_MOST = 0.15  # of a period: 0.3 ms at 500 Hz
COLUMNS = ("t_s", "missed", "late_s", "age_s", "switches", "page_faults")
CALM_PER_s = 50.0  # involuntary switches


def look_at_last_recording(folder: Path) -> list[Finding]:
    """Judge the newest file of recordings in `folder`; nothing if there is none, or it has no such columns."""
    files = [path for path in folder.glob(f"*{SUFFIX}") if path.is_file()]
    if not files:
        return []
    newest = max(files, key=lambda path: path.stat().st_mtime)
    try:
        recording = Recording.open(newest)
        with np.errstate(invalid="ignore"):  # damaged rows
            columns = _columns(recording)
    except (ArmError, OSError, ValueError) as error:
        return [Finding(Level.WARN, LAST_RECORDING, newest.name, "cannot be read", "", str(error))]
    if columns is None or len(columns) < 2:
        return []
    with np.errstate(all="ignore"):
        return _judged(newest.name, columns, float(recording.header.get("period_s", 0.002)))


def _columns(recording: Recording) -> NDArray[np.float64] | None:
    """COLUMNS of all rows (m, 6); None for recordings of earlier versions."""
    layout = recording.layout
    if not set(COLUMNS) <= set(layout.names):
        return None
    kind = row_type(layout.names, layout.packing)
    parts = [np.frombuffer(packed, dtype=kind) for packed in RowReader(recording).portions()]
    taken = [np.stack([part[name].astype(float) for name in COLUMNS], axis=1) for part in parts]
    return np.concatenate(taken) if taken else None


def _judged(name: str, columns: NDArray[np.float64], period_s: float) -> list[Finding]:
    t_s, missed, late_s, age_s, switches, page_faults = columns.T
    duration_s = max(float(t_s[-1] - t_s[0]), 1e-6)
    age_s = age_s[np.isfinite(age_s)]
    p50, p99 = (float(np.quantile(age_s, share)) if len(age_s) else float("nan") for share in (0.5, 0.99))
    late_p99 = float(np.quantile(late_s, 0.99))
    per_s = float(switches.sum()) / duration_s
    return [
        graded(
            LAST_RECORDING,
            "age of the counts",
            p99,
            (AGE_MOST * period_s, 5.0 * period_s),
            (
                f"{1e3 * p50:.2f} ms, 99 % below {1e3 * p99:.2f} ms, in {name}",
                f"99 % below {1e3 * AGE_MOST * period_s:.2g} ms",
                "look at the lateness below, and at the latency timer of the serial port",
            ),
        ),
        graded(
            LAST_RECORDING,
            "lateness of the loop",
            late_p99,
            (0.5 * period_s, 5.0 * period_s),
            (
                f"99 % within {1e3 * late_p99:.2f} ms, {missed[-1] - missed[0]:.0f} cycles missed in {duration_s:.0f} s",
                f"below {500 * period_s:.2g} ms",
                "give the operator the real-time rights (see host)",
            ),
        ),
        graded(
            LAST_RECORDING,
            "what took its time",
            per_s,
            (CALM_PER_s, math.inf),
            (
                f"{switches.sum():.0f} involuntary switches, {page_faults.sum():.0f} page faults",
                f"at most {CALM_PER_s:.0f} switches a second",
                "end other programs; give the operator the real-time rights (see host)",
            ),
        ),
    ]
