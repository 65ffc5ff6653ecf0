"""The boards in arm.toml, for `armwright doctor`: opened, identified, checked, then listened to for some seconds.

Each failure is a finding; the other boards are still checked. No drive is enabled.
"""

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partialmethod

from control.hardware.board_stop import knows_motor
from control.hardware.boards import Encoders, Opened
from control.hardware.connect import open_boards as open_kinds
from control.hardware.interface import Feedback
from control.hardware.reference_boards import start_stream
from control.model.arm import Arm, Drive, EncoderBoardPort
from control.model.drive import JointMap
from firmware_iface.can_link import open_can
from firmware_iface.clock import Clock
from firmware_iface.encoder import wire as encoder_wire
from firmware_iface.encoder.board import EncoderBoard
from firmware_iface.errors import BoardSilent, LinkError, PortInUse, PortMissing
from firmware_iface.motor.board import MotorBoard
from firmware_iface.motor.bus import BusScan, MotorBus, listen, scan_nodes
from firmware_iface.motor.wire import MotorParameter, ResetCause
from firmware_iface.serial_link import open_serial
from procedures.doctor.finding import SUPPLY_LIMITS, Finding, Level, graded
from procedures.doctor.host import CountedLink

GROUP = "boards"
LISTEN_S = 0.1
# Of the 25 of a servo's spline. A joint that is off may rest on its end stop, a little beyond its range.
HALF_A_TOOTH_rad = math.pi / 25
ASKED = 50  # questions to a bought board, to see how fast it answers
_RESETS = {
    ResetCause.WATCHDOG: ("its watchdog ended a program that hung", "update its firmware; switch it off and on, and look again"),
    ResetCause.LOW_SUPPLY: ("its own supply broke down", "check its 3.3 V, the cable, and what else hangs on that supply"),
}
OTHER_BAUDS = (1_000_000, 921_600, 500_000, 460_800, 230_400, 115_200)


@dataclass(slots=True)
class AnsweringBoards:
    """The boards that answered: encoder boards by their index in arm.toml, motor boards by joint."""

    encoders: dict[int, EncoderBoard] = field(default_factory=dict)
    motors: dict[int, MotorBoard] = field(default_factory=dict)
    bus: MotorBus | None = None
    counted: CountedLink | None = None
    findings: list[Finding] = field(default_factory=list)
    may_command: bool = True
    closers: list[Callable[[], None]] = field(default_factory=list)

    def close(self) -> None:
        """Stop the streams and close all links."""
        for encoder in self.encoders.values():
            with contextlib.suppress(LinkError):
                encoder.stream(0.0)
        for close in self.closers:
            close()

    def note(self, level: Level, what: str, measured: str, expected: str = "", remedy: str = "") -> None:
        """Add a finding about boards."""
        self.findings.append(Finding(level, GROUP, what, measured, expected, remedy))

    ok = partialmethod(note, Level.OK)
    warn = partialmethod(note, Level.WARN)
    bad = partialmethod(note, Level.BAD)


def open_boards(arm: Arm, clock: Clock, period_s: float) -> AnsweringBoards:
    """Open the boards of arm.toml and identify them; nothing is enabled, nothing moves. Never raises LinkError."""
    boards = AnsweringBoards()
    _open_bought(boards, arm, clock, period_s)
    if not arm.encoder_boards and any(drive.encoder_board >= 0 for drive in arm.drives):
        boards.bad("encoder boards", "arm.toml names none", "", "add [[encoder_board]] to arm.toml, or give --encoder")
    for index, port in enumerate(arm.encoder_boards):
        _open_encoder(boards, arm, clock, index, port)
    if all(drive.board for drive in arm.drives) and arm.drives:
        return boards
    if arm.can is None:
        remedy = "add [can] to arm.toml, or give --can-interface and --can-channel"
        boards.bad("CAN bus", "arm.toml names none", "", remedy)
        return boards
    _open_bus(boards, arm, clock)
    return boards


def _open_bought(boards: AnsweringBoards, arm: Arm, clock: Clock, period_s: float) -> None:
    """Open the [[board]]s, and time how fast they answer."""
    for drive in arm.drives:
        if drive.pid.mode in arm.kind_of(drive).frees_in:
            boards.warn(
                f"joint {drive.joint}: without the host",
                f'frees its motor in mode "{drive.pid.mode}": nothing stops the joint, and a loaded arm drops',
                "held or braked",
                'take mode = "position", or fit a brake',
            )
    opened = Opened(arm, clock, period_s)
    open_kinds(opened)
    boards.closers += opened.closers
    for where, identity in opened.identities:
        boards.ok(where, identity)
    for failure in opened.failures:
        remedy = "docs/boards.md has a page for each kind"
        if isinstance(failure, PortMissing):
            remedy = "connect the board, or correct the port of its [[board]] in arm.toml"
        boards.bad("bought boards", str(failure), "", remedy)
    for encoders in opened.encoders:
        joint = encoders.joints[0] + 1
        name = f"joint {joint}" if joint <= arm.joint_count else "gripper"
        what = f"{name}: answers with its counts"
        try:
            took_s = sorted(_took_s(encoders, clock) for _ in range(ASKED))
        except LinkError as error:
            boards.bad(what, str(error))
            continue
        # A board that reports by itself may have just done so.
        limit_s = (0.5 if encoders.is_asked else 1.5) * period_s
        level = Level.OK if took_s[-1] < limit_s else Level.WARN
        measured = f"within {1e3 * took_s[-1]:.1f} ms, half of them within {1e3 * took_s[ASKED // 2]:.1f} ms"
        share = "half a cycle" if encoders.is_asked else "one and a half cycles"
        expected = f"within {1e3 * limit_s:.1f} ms: {share}"
        remedy = (
            "lower --rate, raise the baud rate, or give each board a line of its own"
            if encoders.is_asked
            else "lower --rate, or raise the rate of the board's status messages"
        )
        boards.note(level, what, measured, expected, "" if level is Level.OK else remedy)
    _look_at_values(boards, arm, opened)


def _look_at_values(boards: AnsweringBoards, arm: Arm, opened: Opened) -> None:
    """What the answers said of supply and place: of another version of a servo, or a zero that is not the joint's."""
    counted = {joint for encoders in opened.encoders for joint in encoders.joints}
    driven = {joint for drives in opened.drives for joint in drives.joints}
    feedback = Feedback(1 + max(counted | driven, default=-1))
    for encoders in opened.encoders:
        encoders.take(feedback)
    for drives in opened.drives:
        drives.take(feedback)
    for drive in arm.drives:
        joint, name = drive.joint - 1, f"joint {drive.joint}"
        if joint in driven and (supply_V := feedback.supply_V[joint]) > 0.0:
            boards.findings.append(
                graded(
                    GROUP,
                    f"{name}: supply",
                    abs(supply_V / drive.supply_V - 1.0),
                    SUPPLY_LIMITS,
                    (f"{supply_V:.1f} V", f"{drive.supply_V:g} V", "check the supply, and `servo` or supply_V in arm.toml"),
                )
            )
        repeats_rad = arm.unique_rad(drive)
        if joint not in counted or math.isinf(repeats_rad) or math.isinf(feedback.reported_at_s[joint]):
            continue
        q_rad = JointMap(drive).radians(feedback.count[joint])
        lower, upper = drive.joint_lower_rad, drive.joint_upper_rad
        places = (q_rad + turns * repeats_rad for turns in (-1, 0, 1))
        if min(max(lower - place, place - upper) for place in places) > HALF_A_TOOTH_rad:
            boards.warn(
                f"{name}: where it stands",
                f"{q_rad:.3f} rad",
                f"{lower:.3f} to {upper:.3f} rad, its range",
                "turn it into its range by hand; if it is there, its zero_count is not the count of its zero, or its horn is on"
                " another tooth",
            )


def _took_s(encoders: Encoders, clock: Clock) -> float:
    begun_s = clock.now_s()
    encoders.fresh_count(encoders.joints[0])
    return clock.now_s() - begun_s


def _open_encoder(boards: AnsweringBoards, arm: Arm, clock: Clock, index: int, port: EncoderBoardPort) -> None:
    what = f'encoder board "{port.name}"'
    try:
        link = open_serial(port.port, port.baud)
    except LinkError as error:
        boards.bad(what, str(error), "", _port_remedy(error))
        return
    boards.closers.append(link.close)
    board = EncoderBoard(link, clock, port.name)
    try:
        identity = board.identify()
    except BoardSilent as error:
        link.close()
        boards.bad(what, str(error), "an IDENTITY", _silence_remedy(port, clock))
        return
    except LinkError as error:
        boards.bad(what, str(error), "", "connect the right board to this port")
        return
    boards.encoders[index] = board
    firmware = f"{identity.firmware >> 8}.{identity.firmware & 255}"
    boards.ok(
        what,
        f"{port.port}: serial number {identity.serial_number}, firmware {firmware}, {identity.channels} channels,"
        f" {identity.encoder_bits}-bit counters",
    )
    _compare_encoder(boards, arm, index, identity)


def _compare_encoder(boards: AnsweringBoards, arm: Arm, index: int, identity: encoder_wire.Identity) -> None:
    port = arm.encoder_boards[index]
    what = f'encoder board "{port.name}"'
    if port.serial_number not in (None, identity.serial_number):
        remedy = "swap the plugs, or correct [[encoder_board]] serial_number"
        boards.bad(f"{what}: serial number", str(identity.serial_number), str(port.serial_number), remedy)
    for drive in arm.drives:
        if drive.encoder_board != index:
            continue
        if drive.encoder_channel >= identity.channels:
            remedy = f"correct encoder_channel of joint {drive.joint} (from 0)"
            boards.bad(
                f"{what}: joint {drive.joint}", f"{identity.channels} channels", f"a channel {drive.encoder_channel}", remedy
            )
            continue
        _compare_counts(boards, what, drive, identity.counts_per_turn[drive.encoder_channel])
        if drive.encoder_bits != identity.encoder_bits:
            boards.bad(
                f"{what}: joint {drive.joint}, counter bits",
                str(identity.encoder_bits),
                str(drive.encoder_bits),
                "correct encoder_bits in arm.toml",
            )


def _compare_counts(boards: AnsweringBoards, what: str, drive: Drive, counts: int) -> None:
    if counts == drive.encoder_counts_per_rev:
        return
    boards.bad(
        f"{what}: joint {drive.joint}, counts per turn",
        str(counts),
        str(drive.encoder_counts_per_rev),
        "correct encoder_counts_per_rev, or configure the board for its encoder; `armwright bringup` measures the true value",
    )


def _port_remedy(error: LinkError) -> str:
    if isinstance(error, PortInUse):
        return ""  # it says so itself
    problem = str(error)
    if "ermission" in problem:
        return "add your user to the port's group (`sudo usermod -aG dialout $USER`) and log in again"
    if "exclusive" in problem or "busy" in problem or "lock" in problem:
        return "another program uses the port: end it (`armwright off --quit` ends a runtime)"
    return "connect the board, or correct its port in arm.toml"


def _silence_remedy(port: EncoderBoardPort, clock: Clock) -> str:
    """Try other baud rates: a board that answers there is not dead."""
    for baud in OTHER_BAUDS:
        if baud != port.baud and _answers(port, baud, clock):
            return f"it answers at {baud} baud: set baud = {baud} in [[encoder_board]]"
    return "it answers at no usual baud rate; check its supply and cable, and that TX goes to RX"


def _answers(port: EncoderBoardPort, baud: int, clock: Clock) -> bool:
    with contextlib.suppress(LinkError):
        link = open_serial(port.port, baud)
        try:
            EncoderBoard(link, clock, port.name).identify()
            return True
        finally:
            link.close()
    return False


def _open_bus(boards: AnsweringBoards, arm: Arm, clock: Clock) -> None:
    can = arm.can
    if can is None:
        return
    try:
        link = open_can(can.interface, can.channel, can.bitrate, **can.options)
    except PortMissing as error:
        in_use = isinstance(error, PortInUse)
        remedy = "" if in_use else "bring the interface up, or correct [can] in arm.toml"
        boards.bad("CAN bus", str(error), "", remedy)
        return
    boards.closers.append(link.close)
    counted = boards.counted = CountedLink(link)
    try:
        before = listen(counted, clock, LISTEN_S)
        scan = scan_nodes(counted, clock)
    except LinkError as error:
        boards.bad("CAN bus", str(error), "", "check adapter, termination (120 ohm at both ends) and bit rate")
        return
    _judge_bus(boards, arm, before, scan)
    boards.bus = MotorBus(counted, clock)
    for drive in arm.drives:
        _check_motor(boards, arm, drive, scan)


def _judge_bus(boards: AnsweringBoards, arm: Arm, before: BusScan, scan: BusScan) -> None:
    where = arm.can.channel if arm.can else ""
    commanded = sorted(before.commanded | scan.commanded)
    if commanded:
        boards.may_command = False
        nodes = ", ".join(map(str, commanded))
        boards.bad(
            "CAN bus",
            f"another host commands node {nodes}",
            "one host per bus",
            ("end the other program (`armwright off --quit` ends a runtime); the doctor sends nothing to the boards until then"),
        )
    strangers = before.strangers + scan.strangers
    if strangers:
        boards.warn(
            "CAN bus",
            f"{strangers} frames of devices other than motor boards",
            "none",
            "remove CANopen and other devices from this bus: id 0 stops the arm",
        )
    nodes = ", ".join(map(str, sorted(scan.serial_numbers))) or "none"
    boards.ok("CAN bus", f"{where}: answering nodes: {nodes}")
    known = {drive.motor_node for drive in arm.drives}
    for node in sorted(set(scan.serial_numbers) - known):
        boards.warn(
            f"node {node}",
            "a motor board that is not in arm.toml",
            "",
            f"set motor_node = {node} at its joint, or give the board another node id",
        )


def _check_motor(boards: AnsweringBoards, arm: Arm, drive: Drive, scan: BusScan) -> None:
    what = f"motor board of joint {drive.joint} (node {drive.motor_node})"
    if len(scan.serial_numbers.get(drive.motor_node, [])) != 1:
        _note_not_one(boards, arm, drive, scan, what)
        return
    if boards.bus is None:
        return
    board = MotorBoard(boards.bus, drive.motor_node, f"joint {drive.joint}")
    try:
        identity = board.identify()
    except LinkError as error:
        boards.bad(what, str(error), "", "update the board's firmware, or remove the other host from the bus")
        return
    boards.motors[drive.joint] = board
    firmware = f"{identity.firmware >> 8}.{identity.firmware & 255}"
    boards.ok(what, f"serial number {identity.serial_number}, firmware {firmware}")
    if drive.motor_serial_number not in (None, identity.serial_number):
        remedy = "two boards or node ids may be swapped: correct motor_node or motor_serial_number"
        boards.bad(f"{what}: serial number", str(identity.serial_number), str(drive.motor_serial_number), remedy)
    if knows_motor(drive):
        _compare_counts(boards, what, drive.at_motor, identity.encoder_counts_per_turn)
    _judge_reset(boards, what, board)


def _judge_reset(boards: AnsweringBoards, what: str, board: MotorBoard) -> None:
    """What made the board start last, where it says so: firmware of before 2026-11 does not."""
    try:
        cause = board.read(MotorParameter.RESET_CAUSE)
    except LinkError:
        return
    if cause in _RESETS:
        measured, remedy = _RESETS[ResetCause(cause)]
        boards.warn(f"{what}: last start", measured, "a power-up", remedy)


def _note_not_one(boards: AnsweringBoards, arm: Arm, drive: Drive, scan: BusScan, what: str) -> None:
    serials = scan.serial_numbers.get(drive.motor_node, [])
    if not serials:
        unknown = sorted(set(scan.serial_numbers) - {d.motor_node for d in arm.drives})
        hint = f"; node {unknown[0]} answers but has no joint and may be this board" if unknown else ""
        if scan.serial_numbers:
            remedy = f"check its supply and its node id{hint}"
        else:
            remedy = "no board answers: check supply, emergency stop, CAN-H and CAN-L, termination, and [can] bitrate"
        boards.bad(what, "does not answer", "an answer within 5 ms", remedy)
    else:
        both = " and ".join(map(str, serials))
        boards.bad(what, f"two boards answer: serial numbers {both}", "one", "give each board its own node id")


# Samples some seconds of the loop's traffic with the drives off: reports, replies and their times.
#
# The motor boards get the COMMAND that keeps them off at the loop's rate; they answer it like any other.


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
    samples = BoardSamples(duration_s, period_s)
    for index, encoder in boards.encoders.items():
        samples.encoders[index] = EncoderSamples()
        try:
            start_stream(encoder, period_s)
        except LinkError as error:
            samples.problems.append(str(error))
    samples.motors = {joint: MotorSamples() for joint in boards.motors}
    _count(boards, samples, -1)
    begun_s = clock.now_s()
    cycles = round(duration_s / period_s)
    looks_s: set[float] = set()
    sent_s: list[float] = []
    for cycle in range(cycles):
        if not _command(boards, samples):
            break
        sent_s.append(clock.now_s())
        for part in range(1, POLLS + 1):
            clock.wait_until_s(begun_s + (cycle + part / POLLS) * period_s)
            looks_s.add(clock.now_s())
            _hear(boards, samples, clock.now_s(), sent_s)
    samples.duration_s = clock.now_s() - begun_s
    samples.resolution_s = samples.duration_s / max(len(looks_s), 1)
    _count(boards, samples, 1)
    return samples


def _command(boards: AnsweringBoards, samples: BoardSamples) -> bool:
    """Send one COMMAND to each motor board; False if the bus is lost."""
    if not boards.may_command:
        return True
    for joint, motor in boards.motors.items():
        try:
            motor.command_off()
        except LinkError as error:
            samples.problems.append(str(error))
            return False
        samples.motors[joint].commands += 1
    return True


def _hear(boards: AnsweringBoards, samples: BoardSamples, now_s: float, sent_s: list[float]) -> None:
    for index, encoder in boards.encoders.items():
        before = encoder.reports
        _noting(samples, encoder.update)
        if encoder.reports > before and encoder.latest is not None:
            stream, report = samples.encoders[index], encoder.latest
            stream.arrived_s.append(now_s)
            stream.latched_s.append(encoder.board_time_s)
            stream.counts.append(report.counts)
            stream.flags = [a | b for a, b in zip(stream.flags, report.flags, strict=True)]
            stream.zero_set = [bool(flags & 8) for flags in report.flags]
    if boards.bus is None:
        return
    before_replies = {joint: motor.replies for joint, motor in boards.motors.items()}
    _noting(samples, boards.bus.update)
    for joint, motor in boards.motors.items():
        if motor.replies > before_replies[joint] and boards.may_command:
            _take_reply(samples.motors[joint], motor, now_s, sent_s)


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


def _noting(samples: BoardSamples, update: Callable[[], None]) -> None:
    try:
        update()
    except LinkError as error:
        if str(error) not in samples.problems:
            samples.problems.append(str(error))


def _count(boards: AnsweringBoards, samples: BoardSamples, sign: int) -> None:
    """Add the change of the boards' counters: called with -1 at the beginning and +1 at the end."""
    for index, encoder in boards.encoders.items():
        stream = samples.encoders[index]
        stream.reports += sign * encoder.reports
        stream.lost += sign * encoder.lost
        stream.bad_frames += sign * (encoder.crc_errors + encoder.framing_errors)
    for joint, motor in boards.motors.items():
        samples.motors[joint].replies += sign * motor.replies
    samples.can_frames += sign * (boards.counted.frames if boards.counted else 0)
