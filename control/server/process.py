"""The loop process in real time, run by `armwright serve`, and the events that it prints.

SIGINT and SIGTERM start the shutdown: controlled stop, hold, windings shorted until the arm is at rest, drives off. A second
signal during that changes nothing; the emergency stop is a switch, not a signal.
"""

import contextlib
import math
import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path

from control.hardware.connect import AttendedClock, Connection, connect_cell
from control.loop.runtime import Runtime
from control.model.arm import Arm
from control.model.cell import Cell
from control.model.description import arm_text
from control.model.drive import JointMap
from control.recording.cell_folder import new_folder
from control.recording.record import PipeSink, about_cell, about_columns, layout_of
from control.recording.recorder_state import RecorderState, hours_left
from control.recording.writer import begin, stored_row_bytes
from control.safety.modes import CONTROLLED_MODES, TRAVELLING_MODES, Mode
from control.server.assemble import assemble, assemble_cell
from control.server.channel import linked
from control.server.in_process import Served
from control.server.printer import Printer
from control.server.scheduling import Collector, PeriodicTimer, request_punctuality, strain
from control.server.server import Server, require_free
from control.server.status import step_of
from firmware_iface.clock import Clock, MonotonicClock
from firmware_iface.installation import command
from firmware_iface.interrupts import held

# Events of the arm as lines with local times, printed by `armwright serve`.
#
# Detected between cycles by comparing a few attributes, so that a cycle without events costs a microsecond. Printed by a process
# of its own (control.server.printer), so that a terminal that was stopped with Ctrl-S does not stop the loop.

Say = Callable[[str], None]
REPEAT_S = 5.0  # of the shutdown's present step: a loaded arm sinks for some tens of seconds
POLLED = frozenset(
    ("status", "mode", "average", "average_result", "fault_cycles", "jog", "jog_on")
)  # requests that are not events: frequent, or without effect
BEGUN = {
    Mode.OFF: "drives off",
    Mode.HELD: "held by its boards: `armwright enable` takes it over, `armwright off` lets it go",
    Mode.BRAKED: "windings shorted",
    Mode.HOLDING: "holding",
    Mode.JOGGING: "jog begun",
    Mode.HOMING: "homing begun",
    Mode.STOPPING: "stopping",
    Mode.PAUSED: "paused",
}
ENDED = {Mode.JOGGING: "jog ended", Mode.STOPPING: "stopped", Mode.HOMING: "homing ended"}


class Events:
    """Compares the runtime with its last state; `say` gets each line, without its time."""

    def __init__(self, runtime: Runtime, say: Say) -> None:
        self._runtime = runtime
        self._say = say
        self._mode, self._run = runtime.monitor.mode, runtime.run_number
        self._faults = runtime.monitor.faults
        self._is_homed = runtime.monitor.is_homed
        self._next_step_s = 0.0
        self._gripper: object = None  # its state
        if self._mode is Mode.HELD:
            say(BEGUN[Mode.HELD])

    def look(self) -> None:
        """Report changes since the last call."""
        runtime, monitor = self._runtime, self._runtime.monitor
        if monitor.mode is not self._mode or runtime.run_number != self._run:
            self._say_mode()
        if monitor.faults is not self._faults:
            self._say_faults()
        if monitor.is_homed is not self._is_homed:
            self._is_homed = monitor.is_homed
            self._say("every joint is homed" if self._is_homed else "not homed: zeros unknown")
        if (gripper := runtime.parts.gripper) is not None and gripper.state is not self._gripper:
            self._gripper = gripper.state
            lost = "; it has lost what it held" if gripper.has_lost else ""
            self._say(f"gripper: {gripper.state.value}{f' ({gripper.why})' if gripper.why else ''}{lost}")
        if runtime.bound.is_off and runtime.now_s >= self._next_step_s:
            self._say_step()

    def requested(self, do: str, client: int) -> None:
        """Report an accepted request."""
        if do not in POLLED:
            self._say(f"client {client}: {do}")

    def hung_up(self, client: int) -> None:
        """Report that the client of the active motion has disconnected."""
        self._say(f"client {client} disconnected: its motion is stopped")

    def _say_mode(self) -> None:
        before, self._mode = self._mode, self._runtime.monitor.mode
        self._run = self._runtime.run_number
        self._next_step_s = 0.0
        self._say(self._change(before, self._mode))

    def _change(self, before: Mode, mode: Mode) -> str:
        motion = self._runtime.motion
        if mode is Mode.MOVING:
            took = f", {motion.duration_s:.1f} s" if motion is not None else ""
            return "resumed" if before is Mode.PAUSED else f"motion {self._run} begun{took}"
        if mode is Mode.GUIDING:
            carried = "the drives carry the arm's weight" if self._runtime.is_weightless else "drives open"
            return f"hand-guiding: {carried}"
        if mode is Mode.FAULT:
            return "FAULT: stopping" if self._runtime.monitor.is_held_fault else "FAULT: windings shorted"
        if mode is Mode.HOLDING and (before in TRAVELLING_MODES or before in ENDED):
            return f"{ENDED.get(before, f'motion {self._run} ended')}: holding"
        is_braked_late = mode is Mode.BRAKED and before in CONTROLLED_MODES
        return "windings shorted: the arm may sink" if is_braked_late else BEGUN[mode]

    def _say_faults(self) -> None:
        known, self._faults = self._faults, self._runtime.monitor.faults
        for fault in self._faults:
            if fault not in known:
                self._say(f"FAULT {fault.where}: {fault.message}; {fault.remedy}")
        if known and not self._faults:
            self._say("faults acknowledged")

    def _say_step(self) -> None:
        self._next_step_s = self._runtime.now_s + REPEAT_S
        if step := step_of(self._runtime):
            self._say(f"shutdown: {step}")


def with_time(text: str) -> str:
    """Format a line for printing, with the local time first."""
    return f"{time.strftime('%H:%M:%S')}  {text}\n"


PIPE_bytes = 1 << 20  # some seconds of rows, in case the disk stalls


@dataclass(frozen=True, slots=True)
class ServeOptions:
    """Options of the runtime's server; sockets and UDP ports of cameras by the arms' names."""

    sockets: Mapping[str, Path]
    log_folder: Path
    period_s: float
    camera_ports: Mapping[str, int | None]


def serve(cell: Cell, options: ServeOptions) -> None:
    """Connect, then run the loop until it is told to end. Raises what connecting raises, before anything moves.

    Events are printed as lines with local times.
    """
    for path in options.sockets.values():
        require_free(path)  # before a second host sends anything to the boards
    clock = MonotonicClock()
    connection = connect_cell(cell, clock, options.period_s, options.camera_ports)
    folder = _folder(cell, options.log_folder)
    arms = {
        placed.name: _begun(cell, placed.arm, connection.of_arms[placed.name], folder, options.period_s) for placed in cell.arms
    }
    printer = Printer()
    remedy = request_punctuality()
    try:
        served = _served(cell, arms, options.period_s, {"rights": remedy or "granted"}, printer)
        paths = options.sockets if len(arms) > 1 else options.sockets[cell.names[0]]
        server = Server(paths, served.requests.handle, served.requests.on_gone)
        for name, begun in arms.items():
            text = f"serving arm {name!r} at {options.sockets[name]}, recording to {begun.recording}"
            printer.say(with_time(f"{text} ({_usage(begun.arm, options)})"))
        if remedy:
            printer.say(with_time(remedy))
        try:
            with contextlib.ExitStack() as links:
                for name, path in options.sockets.items():
                    links.enter_context(linked(path, name))
                run(served, server, clock, options.period_s, [begun.events for begun in arms.values()])
        finally:
            server.close()
            printer.say(with_time("the runtime has ended"))
    finally:
        connection.leave_safely()
        for begun in arms.values():
            begun.end_recording()
        printer.close()


@dataclass(slots=True)
class _Begun:
    """An arm that is connected and recorded; `events` once it is assembled."""

    arm: Arm
    connection: Connection
    recording: Path
    writer: "subprocess.Popen[bytes]"
    sink: PipeSink
    events: Events | None = None

    def end_recording(self) -> None:
        """Let the writer drain the pipe, and end it."""
        self.sink.close()
        self.writer.wait()


def _begun(cell: Cell, arm: Arm, connection: Connection, folder: Path, period_s: float) -> _Begun:
    recording = _begun_recording(cell, arm, folder, period_s)
    return _Begun(arm, connection, recording, *_start_writer(arm, recording))


def _served(cell: Cell, arms: Mapping[str, _Begun], period_s: float, about: Mapping[str, object], printer: Printer) -> Served:
    """The runtime: of the only arm, or of all arms of a cell."""
    assemblies = {}
    for name, begun in arms.items():
        opened = begun.connection
        assembly = assemble(begun.arm, opened.hardware, period_s, opened.camera, begun.sink, about=about, strain=strain)
        prefix = f"{name}: " if len(arms) > 1 else ""
        begun.events = assembly.requests.events = Events(assembly.runtime, partial(_say, printer, prefix))
        assemblies[name] = assembly
    return assemble_cell(cell, assemblies) if len(arms) > 1 else assemblies[cell.names[0]]


def _say(printer: Printer, prefix: str, text: str) -> None:
    printer.say(with_time(f"{prefix}{text}"))


def run(served: Served, server: Server, clock: Clock, period_s: float, events: Sequence[Events | None]) -> None:
    """Cycle after cycle, requests in between, until the runtime ends."""
    runtime = served.runtime
    asked_to_end: list[int] = []  # signals come in the middle of anything, of a request that waits for boards, too
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, _: asked_to_end.append(number))
    beat = PeriodicTimer(AttendedClock(clock, runtime), period_s)
    follower = PhaseFollower(runtime.hardware.await_counts, clock, period_s)
    collector = Collector()
    is_running = True
    failure: Exception | None = None
    while is_running:
        late_s = beat.wait()
        deadline_s = clock.now_s() - late_s
        beat.trim_s = follower.wait(deadline_s, beat.skipped)
        now_s = clock.now_s()
        is_running = runtime.cycle(now_s, now_s - deadline_s, beat.skipped, beat.missed_in_row)
        try:
            server.poll()
        except Exception as error:  # bring the arm to rest first, then report the error
            failure = failure or error
            runtime.go_off(quits=True)
        if asked_to_end:
            asked_to_end.clear()
            runtime.go_off(quits=True)
        for arm_events in events:
            if arm_events is not None:
                arm_events.look()
        if runtime.ended_wait(clock.now_s()) | collector.look(clock.now_s(), runtime):
            beat.restart()
    if failure is not None:
        raise failure


def _folder(cell: Cell, log_folder: Path) -> Path:
    """Where to record: an arm alone into the log folder, arms of a cell into a new folder in it."""
    log_folder.mkdir(parents=True, exist_ok=True)
    return new_folder(log_folder, cell.name, _named_for(time.time())) if len(cell.arms) > 1 else log_folder


def _named_for(time_s: float) -> str:
    return time.strftime("%Y%m%d-%H%M%S", time.localtime(time_s))


def _begun_recording(cell: Cell, arm: Arm, folder: Path, period_s: float) -> Path:
    """Create a recording with its header. OSError if there is no room, before anything moves."""
    started_s = time.time()
    path = _free(folder, f"{arm.name}-{_named_for(started_s)}")
    layout = layout_of(arm)
    begin(
        path,
        layout.about(
            arm=arm.name,
            arm_file=str(arm.path),
            arm_toml=arm_text(arm),
            program=f"armwright {version('armwright')}",
            started_unix_s=started_s,
            period_s=period_s,
            **about_cell(cell, arm.name),
            **about_columns(arm),
            **layout.framed([JointMap(drive).radians_per_count for drive in arm.drives]),
        ),
    )
    return path


def _start_writer(arm: Arm, recording: Path) -> tuple["subprocess.Popen[bytes]", PipeSink]:
    read_fd, write_fd = os.pipe()
    _enlarge(write_fd)
    reports, of_writer = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    reports.setblocking(False)
    policy = arm.recording
    with held():
        writer = subprocess.Popen(
            command("control.recording.writer", str(recording), str(policy.rotate_bytes), str(policy.keep_bytes)),
            stdin=read_fd,
            stdout=of_writer.fileno(),
            start_new_session=True,
        )
    os.close(read_fd)
    of_writer.close()
    return writer, PipeSink(write_fd, reports, str(recording))


def _usage(arm: Arm, options: ServeOptions) -> str:
    row_bytes = stored_row_bytes(layout_of(arm).packing.size)
    rate = 3600.0 * row_bytes / options.period_s
    return RecorderState(True, bytes_per_h=rate, hours_left=hours_left(options.log_folder, rate)).usage()


def _free(folder: Path, stem: str) -> Path:
    path, number = folder / f"{stem}.armlog", 1
    while path.exists():
        number += 1
        path = folder / f"{stem}-{number}.armlog"
    return path


def _enlarge(fd: int) -> None:
    import fcntl

    with contextlib.suppress(OSError, AttributeError):
        fcntl.fcntl(fd, fcntl.F_SETPIPE_SZ, PIPE_bytes)


# The loop's phase follows the reports of the first encoder board, and a cycle begins when its counts have come.
#
# A board sends by its own clock, some 100 ppm off the host's, and what it sends is under way for a time that nobody
# tells and that is not the same twice: the line, the adapter, the kernel. So a deadline lies where some of the reports
# have come and most have not, and a cycle waits for the report that is meant for it, as long as BOUND. The report
# begins the cycle; where in their spread the deadline lies hardly matters. It creeps there: earlier after a cycle that
# found its report, later after one that did not. Balanced, LATER / (EARLIER + LATER) of them find it, a quantile that
# neither a long tail nor a lost report can drag along. On a busy host, whose arrivals spread wider than BOUND, cycles
# that waited in vain bring it up to VAIN / (EARLIER + VAIN).
#
# Which report is meant is told by the board's time stamps, one period after the other, so that lost, doubled and late ones do
# not confuse. A board that has sent none for SILENT periods is not waited for.
BOUND = 0.1  # of a period: 0.2 ms at 500 Hz, what a cycle waits for its report at most
EARLIER = 6e-4  # of a period, the creeping a cycle; both are more than clocks differ by, 3e-4
LATER = 4e-4
VAIN = 18e-4  # later, after a cycle whose report did not come in time
SILENT = 2.5  # periods
SAME = 0.25  # of a period, between the time stamps of reports that count as the same: boards send two in a period, or one

AwaitCounts = Callable[[float, float], float]


class PhaseFollower:
    """`await_counts` of `control.hardware.interface.Hardware`, for cycles of `period_s`."""

    def __init__(self, await_counts: AwaitCounts, clock: Clock, period_s: float) -> None:
        self._await_counts, self._clock, self._period_s = await_counts, clock, period_s
        self._made_s = -math.inf  # of the report that was meant for the last cycle, by the board's clock
        self._newest_s = math.nan  # of the newest that came

    def wait(self, deadline_s: float, skipped: int) -> float:
        """Wait for the counts of the cycle that was due at `deadline_s`, after `skipped` others.

        Returns how much longer [s] the next period is to be.
        """
        period_s, until_s = self._period_s, deadline_s + BOUND * self._period_s
        is_in_time = self._clock.now_s() < until_s
        meant_s = self._made_s + (1 + skipped) * period_s
        enough_s = meant_s - SAME * period_s
        newest_s = self._await_counts(enough_s, -math.inf)
        was_there, is_silent = newest_s >= enough_s, not newest_s >= meant_s - SILENT * period_s
        if not was_there and not is_silent:
            newest_s = self._await_counts(enough_s, until_s)
        is_new, self._newest_s = newest_s != self._newest_s, newest_s
        has_come = newest_s >= enough_s
        self._made_s = newest_s if has_come or (is_silent and is_new) else meant_s
        if is_silent or not is_in_time:
            return 0.0
        return (-EARLIER if was_there else LATER if has_come else VAIN) * period_s
