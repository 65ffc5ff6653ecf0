"""Samples some seconds of the loop's traffic with the drives off: reports, replies and their times.

The motor boards get the COMMAND that keeps them off at the loop's rate; they answer it like any other.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

from control.hardware.reference_encoders import start_stream
from firmware_iface.clock import Clock
from firmware_iface.errors import LinkError
from firmware_iface.motor.board import MotorBoard
from procedures.doctor.boards import AnsweringBoards

POLLS = 8  # polls per cycle: arrival times are late by at most an eighth of a cycle


@dataclass(slots=True)
class EncoderSamples:
    """Samples of one encoder board; counts and flags by channel."""

    arrived_s: list[float] = field(default_factory=list)
    latched_s: list[float] = field(default_factory=list)
    """Times by the board's own clock."""
    counts: list[tuple[int, ...]] = field(default_factory=list)
    flags: list[int] = field(default_factory=lambda: [0, 0, 0])
    """All flags that were ever set."""
    zero_set: list[bool] = field(default_factory=lambda: [False, False, False])
    reports: int = 0
    lost: int = 0
    bad_frames: int = 0


@dataclass(slots=True)
class MotorSamples:
    """Samples of one motor board."""

    latency_s: list[float] = field(default_factory=list)
    current_A: list[float] = field(default_factory=list)
    supply_V: list[float] = field(default_factory=list)
    temperature_degC: list[float] = field(default_factory=list)
    commands: int = 0
    replies: int = 0
    faults: int = 0
    """Bits that were ever set."""


@dataclass(slots=True)
class BoardSamples:
    """All samples of `duration_s`."""

    duration_s: float
    period_s: float
    encoders: dict[int, EncoderSamples] = field(default_factory=dict)
    motors: dict[int, MotorSamples] = field(default_factory=dict)
    can_frames: int = 0
    resolution_s: float = 0.0
    """Polling interval, which limits the accuracy of arrival times."""
    problems: list[str] = field(default_factory=list)


def sample(boards: AnsweringBoards, clock: Clock, period_s: float, duration_s: float) -> BoardSamples:
    """Listen for `duration_s`. Problems reported by boards are collected in `problems`; never raises LinkError."""
    found = BoardSamples(duration_s, period_s)
    for index, encoder in boards.encoders.items():
        found.encoders[index] = EncoderSamples()
        try:
            start_stream(encoder, period_s)
        except LinkError as error:
            found.problems.append(str(error))
    found.motors = {joint: MotorSamples() for joint in boards.motors}
    _count(boards, found, -1)
    begun_s = clock.now_s()
    cycles = round(duration_s / period_s)
    looks_s: set[float] = set()
    sent_s: list[float] = []
    for cycle in range(cycles):
        if not _command(boards, found):
            break
        sent_s.append(clock.now_s())
        for part in range(1, POLLS + 1):
            clock.wait_until_s(begun_s + (cycle + part / POLLS) * period_s)
            looks_s.add(clock.now_s())
            _hear(boards, found, clock.now_s(), sent_s)
    found.duration_s = clock.now_s() - begun_s
    found.resolution_s = found.duration_s / max(len(looks_s), 1)
    _count(boards, found, 1)
    return found


def _command(boards: AnsweringBoards, found: BoardSamples) -> bool:
    """Send one COMMAND to each motor board; False if the bus is lost."""
    if not boards.may_command:
        return True
    for joint, motor in boards.motors.items():
        try:
            motor.command_off()
        except LinkError as error:
            found.problems.append(str(error))
            return False
        found.motors[joint].commands += 1
    return True


def _hear(boards: AnsweringBoards, found: BoardSamples, now_s: float, sent_s: list[float]) -> None:
    for index, encoder in boards.encoders.items():
        before = encoder.reports
        _noting(found, encoder.update)
        if encoder.reports > before and encoder.latest is not None:
            samples, report = found.encoders[index], encoder.latest
            samples.arrived_s.append(now_s)
            samples.latched_s.append(encoder.board_time_s)
            samples.counts.append(report.counts)
            samples.flags = [a | b for a, b in zip(samples.flags, report.flags, strict=True)]
            samples.zero_set = [bool(flags & 8) for flags in report.flags]
    if boards.bus is None:
        return
    before_replies = {joint: motor.replies for joint, motor in boards.motors.items()}
    _noting(found, boards.bus.update)
    for joint, motor in boards.motors.items():
        if motor.replies > before_replies[joint] and boards.may_command:
            _take_reply(found.motors[joint], motor, now_s, sent_s)


def _take_reply(seen: MotorSamples, motor: MotorBoard, now_s: float, sent_s: list[float]) -> None:
    """Match a reply with its COMMAND by the echoed sequence number."""
    if motor.reply is None:
        return
    if motor.reply_lag < len(sent_s):
        seen.latency_s.append(now_s - sent_s[-1 - motor.reply_lag])
    seen.current_A.append(motor.reply.current_A)
    seen.supply_V.append(motor.reply.supply_V)
    seen.temperature_degC.append(float(motor.reply.temperature_degC))
    seen.faults |= motor.reply.faults


def _noting(found: BoardSamples, update: Callable[[], None]) -> None:
    try:
        update()
    except LinkError as error:
        if str(error) not in found.problems:
            found.problems.append(str(error))


def _count(boards: AnsweringBoards, found: BoardSamples, sign: int) -> None:
    """Add the change of the boards' counters: called with -1 at the beginning and +1 at the end."""
    for index, encoder in boards.encoders.items():
        samples = found.encoders[index]
        samples.reports += sign * encoder.reports
        samples.lost += sign * encoder.lost
        samples.bad_frames += sign * (encoder.crc_errors + encoder.framing_errors)
    for joint, motor in boards.motors.items():
        found.motors[joint].replies += sign * motor.replies
    found.can_frames += sign * (boards.counted.frames if boards.counted else 0)
