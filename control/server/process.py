"""The loop process in real time, run by `armwright serve`.

SIGINT and SIGTERM start the shutdown: controlled stop, hold, windings shorted until the arm is at rest, drives off. A second
signal during that changes nothing; the emergency stop is a switch, not a signal.
"""

import os
import signal
import socket
import subprocess
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from control.hardware.attended_clock import AttendedClock
from control.hardware.connect import Connection, connect
from control.model.arm import Arm
from control.model.description import arm_text
from control.model.joint_map import JointMap
from control.recording.layout import about_columns, layout_of
from control.recording.record import PipeSink
from control.recording.recorder_state import RecorderState, hours_left
from control.recording.rotation import begin, stored_row_bytes
from control.server.assemble import Assembly, assemble
from control.server.events import Events, with_time
from control.server.periodic import PeriodicTimer
from control.server.phase import PhaseFollower
from control.server.printer import Printer
from control.server.scheduling import request_punctuality, strain
from control.server.server import Server, require_free
from control.server.sockets import linked
from firmware_iface.clock import Clock, MonotonicClock
from firmware_iface.installation import command

PIPE_bytes = 1 << 20  # some seconds of rows, in case the disk stalls


@dataclass(frozen=True, slots=True)
class ServeOptions:
    """Options of the runtime's server."""

    socket_path: Path
    log_folder: Path
    period_s: float
    camera_port: int | None


def serve(arm: Arm, options: ServeOptions) -> None:
    """Connect, then run the loop until it is told to end. Raises what connecting raises, before anything moves.

    Events are printed as lines with local times.
    """
    require_free(options.socket_path)  # before a second host sends anything to the boards
    clock = MonotonicClock()
    connection = connect(arm, clock, options.period_s, options.camera_port)
    recording = _begun_recording(arm, options)
    writer, sink = _start_writer(arm, recording)
    printer = Printer()
    remedy = request_punctuality()
    about = {"rights": remedy or "granted"}
    try:
        assembly = assemble(
            arm, connection.hardware, options.period_s, connection.camera, sink, about=about, strain=strain
        )
        server = Server(options.socket_path, assembly.requests.handle, assembly.requests.on_gone)
        usage = _usage(arm, options)
        printer.say(
            with_time(
                f"serving arm {arm.name!r} at {options.socket_path}, recording to {recording} ({usage})"
            )
        )
        if remedy:
            printer.say(with_time(remedy))
        try:
            with linked(options.socket_path, arm.name):
                run(
                    assembly,
                    server,
                    clock,
                    options.period_s,
                    Events(assembly.runtime, lambda text: printer.say(with_time(text))),
                )
        finally:
            server.close()
            printer.say(with_time("the runtime has ended"))
    finally:
        _leave_safely(connection)
        sink.close()
        writer.wait()
        printer.close()


def run(assembly: Assembly, server: Server, clock: Clock, period_s: float, events: Events) -> None:
    """Cycle after cycle, requests in between, until the runtime ends."""
    runtime = assembly.runtime
    assembly.requests.events = events
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: runtime.go_off(quits=True))
    beat = PeriodicTimer(AttendedClock(clock, runtime.parts.hardware), period_s)
    follower = PhaseFollower(runtime.parts.hardware.reports_a_cycle, period_s)
    is_running = True
    failure: Exception | None = None
    while is_running:
        late_s = beat.wait()
        is_running = runtime.cycle(clock.now_s(), late_s, beat.skipped, beat.missed_in_row)
        feedback = runtime.parts.hardware.feedback
        beat.trim_s = follower.trim_s(feedback.reports, feedback.lost, beat.skipped > 0)
        try:
            server.poll()
        except Exception as error:  # bring the arm to rest first, then report the error
            failure = failure or error
            runtime.go_off(quits=True)
        events.look()
        if runtime.ended_wait(clock.now_s()):
            beat.restart()
    if failure is not None:
        raise failure


def _leave_safely(connection: Connection) -> None:
    """Brake if drives are still on, however the loop ended; their watchdogs would do it a little later."""
    if connection.hardware.is_any_enabled():
        connection.hardware.emergency_stop()
    connection.close()


def _begun_recording(arm: Arm, options: ServeOptions) -> Path:
    """Create a recording with its header. OSError if there is no room, before anything moves."""
    options.log_folder.mkdir(parents=True, exist_ok=True)
    started_s = time.time()
    name = time.strftime("%Y%m%d-%H%M%S", time.localtime(started_s))
    path = _free(options.log_folder, f"{arm.name}-{name}")
    layout = layout_of(arm)
    begin(
        path,
        layout.about(
            arm=arm.name,
            arm_file=str(arm.path),
            arm_toml=arm_text(arm),
            program=f"armwright {version('armwright')}",
            started_unix_s=started_s,
            period_s=options.period_s,
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
    import contextlib
    import fcntl

    with contextlib.suppress(OSError, AttributeError):
        fcntl.fcntl(fd, fcntl.F_SETPIPE_SZ, PIPE_bytes)
