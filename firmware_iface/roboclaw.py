"""RoboClaw boards on a serial line, seen from the host: each has two motors and two quadrature encoders.
The packets come first, without I/O; then the driver.

Packet serial of RoboClaw and Basicmicro motor controllers: bytes of requests and replies.

Source: RoboClaw Series User Manual (Basicmicro), chapters "Packet Serial" and "Advanced Packet Serial". Numbers are big endian.

    to set or command   address, command, data, CRC-16     answered by 0xFF; not at all if the packet was invalid
    to read             address, command                   answered by data, CRC-16 over address, command and data

The CRC has the polynomial 0x1021 and begins at 0 (CRC-16/XMODEM). A gap of more than 10 ms between two bytes of a packet makes
the board discard it.
"""

import contextlib
import math
import struct
from binascii import crc_hqx
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Final

from firmware_iface.clock import Clock
from firmware_iface.errors import BoardReset, BoardSilent, LinkError, MisuseError, Problems, WrongIdentity
from firmware_iface.link import ByteLink
from firmware_iface.polled_line import WRONG, PolledLine, Unfinished

ADDRESSES: Final = range(0x80, 0x88)
ACKNOWLEDGED: Final = 0xFF
PACKET_GAP_s: Final = 0.010  # after so much silence the board has forgotten a partial packet
FULL_DUTY: Final = 32767
FASTEST_DUTY_CHANGE: Final = 655_359  # -100 % to 100 % in 100 ms: what the board allows at most
TIMEOUT_STEP_s: Final = 0.1
LONGEST_VERSION: Final = 48
PIN_MODE_BYTES: Final = (3, 5)  # the manual's S3 to S5; and CTRL1, CTRL2: the vendor's client basicmicro 2.0.10, GETPINFUNCTIONS
HOME_PINS: Final = (0x62, 0x04)  # modes of S4 and S5, as command 74 has them: "Home (User)"; in earlier manuals, "home"
# "Limit (Fwd)", "Limit (Rev)", "Limit (Both)": the board itself stops a motor that drives forward, backward or either way
# into it.
LIMIT_FORWARD, LIMIT_REVERSE = 0x12, 0x22
LIMIT_BOTH: Final = LIMIT_FORWARD | LIMIT_REVERSE
_CRC = struct.Struct(">H")


class RoboclawCommand(IntEnum):
    """Command numbers of the manual; the names are its, too."""

    SET_SERIAL_TIMEOUT = 14  # u8 in 0.1 s
    READ_SERIAL_TIMEOUT = 15
    READ_FIRMWARE_VERSION = 21  # text, line feed, 0
    SET_ENCODER_1 = 22  # u32
    SET_ENCODER_2 = 23
    READ_MAIN_BATTERY = 24  # u16 in 0.1 V
    DUTY_M1_M2 = 34  # i16, i16
    READ_DUTIES = 48  # i16, i16: "PWM" in the manual
    READ_CURRENTS = 49  # i16, i16 in 10 mA
    SET_DUTY_ACCELERATION_1 = 68  # u32 of rise; and u32 of fall where READ_PIN_MODES says five
    SET_DUTY_ACCELERATION_2 = 69
    READ_PIN_MODES = 75  # u8, u8, u8; two more with today's firmware
    READ_ENCODERS = 78  # u32, u32
    READ_TEMPERATURE = 82  # u16 in 0.1 degC
    READ_STATUS = 90  # u32; u16 with other bits in older firmware
    READ_ENCODER_MODES = 91  # u8, u8
    SET_CURRENT_LIMIT_1 = 133  # u32 in 10 mA, u32 0
    SET_CURRENT_LIMIT_2 = 134
    READ_PWM_IDLE = 161  # u8, u8: IDLES and a delay in 0.1 s, of each motor; today's firmware


class RoboclawStatus(IntFlag):
    """Bits of READ_STATUS: errors, which stop the motors, in the lower half; warnings in the upper."""

    E_STOP = 0x0001
    TEMPERATURE = 0x0002
    TEMPERATURE_2 = 0x0004
    MAIN_VOLTAGE_HIGH = 0x0008
    LOGIC_VOLTAGE_HIGH = 0x0010
    LOGIC_VOLTAGE_LOW = 0x0020
    DRIVER_1 = 0x0040
    DRIVER_2 = 0x0080
    SPEED_1 = 0x0100
    SPEED_2 = 0x0200
    POSITION_1 = 0x0400
    POSITION_2 = 0x0800
    CURRENT_1 = 0x1000
    CURRENT_2 = 0x2000
    MAIN_VOLTAGE_LOW = 0x4000
    OVER_CURRENT_WARNING_1 = 0x01_0000
    OVER_CURRENT_WARNING_2 = 0x02_0000
    S4_TRIGGERED = 0x40_0000
    S5_TRIGGERED = 0x80_0000


ERRORS: Final = 0xFFFF
STATUS_BYTES: Final = (2, 4)
# Bits of the older status (Basicmicro's Arduino library, ReadError of two bytes), and today's. Its warnings of supply and
# temperature are none of today's errors.
_OLDER_STATUS: Final = (
    (0x0004, RoboclawStatus.E_STOP),
    (0x0008, RoboclawStatus.TEMPERATURE),
    (0x0010, RoboclawStatus.TEMPERATURE_2),
    (0x0020, RoboclawStatus.MAIN_VOLTAGE_HIGH),
    (0x0040, RoboclawStatus.LOGIC_VOLTAGE_HIGH),
    (0x0080, RoboclawStatus.LOGIC_VOLTAGE_LOW),
    (0x0100, RoboclawStatus.DRIVER_1),
    (0x0200, RoboclawStatus.DRIVER_2),
    (0x0001, RoboclawStatus.OVER_CURRENT_WARNING_1),
    (0x0002, RoboclawStatus.OVER_CURRENT_WARNING_2),
    (0x4000, RoboclawStatus.S4_TRIGGERED),
    (0x8000, RoboclawStatus.S5_TRIGGERED),
)
IDLES: Final = 0x80  # at duty 0, after the delay, the motor is free
QUADRATURE_ONLY: Final = 0x9F  # of an encoder mode: neither absolute nor RC/analog; bits 5 and 6 only reverse senses


def status(data: bytes) -> RoboclawStatus:
    """Data of READ_STATUS, of either firmware."""
    flags = int.from_bytes(data, "big")
    if len(data) == STATUS_BYTES[0]:
        flags = sum(bit for older, bit in _OLDER_STATUS if flags & older)
    return RoboclawStatus(flags)


def command_packet(address: int, command: int, data: bytes = b"") -> bytes:
    """A packet that sets or commands something."""
    body = bytes((address, command)) + data
    return body + _CRC.pack(crc_hqx(body, 0))


def read_packet(address: int, command: int) -> bytes:
    """A packet that reads something: without a CRC."""
    return bytes((address, command))


def reply_data(address: int, command: int, reply: bytes) -> bytes | None:
    """The data of a reply to a read, or None if its CRC is wrong: another board's, another command's, or noise."""
    data, crc = reply[:-2], reply[-2:]
    return data if crc == _CRC.pack(crc_hqx(bytes((address, command)) + data, 0)) else None


def duty_data(duty_1: int, duty_2: int) -> bytes:
    """Data of DUTY_M1_M2."""
    return struct.pack(">hh", duty_1, duty_2)


def pair_of_counts(data: bytes) -> tuple[int, int]:
    """Data of READ_ENCODERS, as signed 32-bit counts."""
    first, second = struct.unpack(">ii", data)
    return first, second


def pair_of_currents_A(data: bytes) -> tuple[float, float]:
    """Data of READ_CURRENTS."""
    first, second = struct.unpack(">hh", data)
    return first * 0.01, second * 0.01


def tenths(data: bytes) -> float:
    """Data of READ_MAIN_BATTERY in V, of READ_TEMPERATURE in degC."""
    (value,) = struct.unpack(">H", data)
    return float(value) * 0.1


# The board answers within 2 ms; the manual's own time-out is also what clears its packet buffer.
ANSWER_TIMEOUT_s = PACKET_GAP_s
VERSION_BYTES = -1  # as `reply_bytes`: text that ends with 0


@dataclass(frozen=True, slots=True, eq=False)
class RoboclawQuestion:
    """A command of the manual and its answer; meets `firmware_iface.polled_line.Question`.

    `reply_bytes`: of data, without the CRC; several, ascending, where firmwares differ; None: an acknowledgement; VERSION_BYTES:
    text. `take` gets the data and when the request was sent, on the host's clock.
    """

    address: int
    command: int
    reply_bytes: int | tuple[int, ...] | None
    take: Callable[[bytes, float], None]
    data: Callable[[], bytes] | None = None

    @property
    def answer_bytes(self) -> int:
        """The most bytes of its answer."""
        if self.reply_bytes is None:
            return 1
        if isinstance(self.reply_bytes, tuple):
            return self.reply_bytes[-1] + 2
        return (LONGEST_VERSION if self.reply_bytes == VERSION_BYTES else self.reply_bytes) + 2

    def packet(self) -> bytes:
        """The bytes to send."""
        if self.reply_bytes is not None:
            return read_packet(self.address, self.command)
        return command_packet(self.address, self.command, self.data() if self.data else b"")

    def answered(self, received: bytes) -> bytes | None:
        """The data in an answer. Raises Unfinished."""
        for wanted in self._lengths(received):
            if len(received) < wanted:
                raise Unfinished
            if self.reply_bytes is None:
                return b"" if received[0] == ACKNOWLEDGED else WRONG
            if (data := reply_data(self.address, self.command, received[:wanted])) is not None:
                return data
        return WRONG

    def _lengths(self, received: bytes) -> tuple[int, ...]:
        """Lengths that the whole answer may have. Raises Unfinished while they are unknown."""
        if isinstance(self.reply_bytes, tuple):
            return tuple(count + 2 for count in self.reply_bytes)
        if self.reply_bytes != VERSION_BYTES:
            return (self.answer_bytes,)
        if (end := received.find(0)) < 0:
            raise Unfinished
        return (end + 3,)


class PacketLine(PolledLine):
    """One line with up to eight boards."""

    def __init__(self, link: ByteLink, clock: Clock) -> None:
        super().__init__(link, clock, ANSWER_TIMEOUT_s)

    def read(self, address: int, command: int, reply_bytes: int | tuple[int, ...], where: str) -> bytes:
        """Read something from a board; waits. Raises BoardSilent."""
        return self._ask(address, command, reply_bytes, None, where)

    def command(self, address: int, command: int, data: bytes, where: str) -> None:
        """Set or command something, and wait for the acknowledgement. Raises BoardSilent."""
        self._ask(address, command, None, lambda: data, where)

    def _ask(
        self, address: int, command: int, reply_bytes: int | tuple[int, ...] | None, data: Callable[[], bytes] | None, where: str
    ) -> bytes:
        answers: list[bytes] = []
        question = RoboclawQuestion(address, command, reply_bytes, lambda got, _: answers.append(got), data)
        remedy = f"check its supply, packet serial mode, address {address:#04x}"
        self.converse(question, lambda: bool(answers), f"{where}: no answer to command {command}", remedy)
        return answers[0]


CHANNELS = 2
LONGEST_WAITED = 20  # in 0.1 s; one with a longer time-out, as with none (0), counts as holding what it drives
LEAST_TIMEOUT = 1  # in 0.1 s; 0 switches the board's time-out off


@dataclass(frozen=True, slots=True)
class RoboClawIdentity:
    """What a board says of itself: product and firmware version, pin and encoder modes."""

    version: str
    pin_modes: tuple[int, ...]  # of S3, S4, S5; today's firmware adds CTRL1, CTRL2
    encoder_modes: tuple[int, int]
    pwm_idle: tuple[int, int] = (0, 0)  # of both motors; firmware that does not tell of it has none


class RoboClaw:
    """Keeps the latest values of a board and its wanted duties; the line asks for them, and sends these.

    Values are None or old until the board has answered; times are the host's, when the request was sent. `problems` holds what
    `update` of the line's owner has to raise.
    """

    def __init__(self, line: PacketLine, address: int, name: str) -> None:
        if address not in ADDRESSES:
            raise MisuseError(f'RoboClaw "{name}": addresses are 128 to 135 (0x80 to 0x87), got {address}')
        self.name = name
        self.address = address
        self.duty = [0, 0]
        """Wanted duties, -32767 to 32767 of the supply."""
        self.is_commanded = False
        """Whether duties are sent; until then the motors go on with what they were found with."""
        self.found_duty = (0, 0)
        self.sent_duty = (0, 0)
        self.counts = (0, 0)
        self.counted_at_s = -math.inf
        self.count_late_s = 0.0  # by how much younger the counts may be
        self.currents_A = (0.0, 0.0)
        self.currents_at_s = -math.inf
        self.obeyed_at_s = -math.inf
        self.supply_V: float | None = None
        self.temperature_degC = 0.0
        self.status: RoboclawStatus | None = None
        self.identity: RoboClawIdentity | None = None
        self.resets = 0
        self.problems: list[LinkError] = Problems()
        self._line = line
        self._timeout: int | None = None  # as set, in 0.1 s
        self.counts_question = RoboclawQuestion(address, RoboclawCommand.READ_ENCODERS, 8, self._take_counts)
        self._duty = RoboclawQuestion(address, RoboclawCommand.DUTY_M1_M2, None, self._take_duty, self._duty_data)
        self._currents = RoboclawQuestion(address, RoboclawCommand.READ_CURRENTS, 4, self._take_currents)
        status = RoboclawQuestion(address, RoboclawCommand.READ_STATUS, STATUS_BYTES, self._take_status)
        self._slow = (
            status,
            RoboclawQuestion(address, RoboclawCommand.READ_MAIN_BATTERY, 2, self._take_supply),
            status,
            RoboclawQuestion(address, RoboclawCommand.READ_SERIAL_TIMEOUT, 1, self._take_timeout),
            status,
            RoboclawQuestion(address, RoboclawCommand.READ_TEMPERATURE, 2, self._take_temperature),
        )
        self._turn = 0
        self._has_limit_switch = False

    @property
    def where(self) -> str:
        """Name in messages: `RoboClaw "base" (address 0x80) on /dev/ttyACM0`."""
        return f'RoboClaw "{self.name}" (address {self.address:#04x}) on {self._line.name}'

    def post_duties(self) -> None:
        """Queue the wanted duties: first in a cycle."""
        self._line.post(self._duty)

    def post_cycle(self) -> None:
        """Queue what else a cycle needs: currents, and in turn status, supply, time-out and temperature.

        The encoders are read in the rest of the cycle, again and again.
        """
        self._line.post(self._currents)
        if self._has_limit_switch and self._turn % 2:
            self._line.post(self._slow[0])  # the status, in each cycle: at its switch the board overrides the duty
        self._line.post(self._slow[self._turn])
        self._turn = (self._turn + 1) % len(self._slow)

    def stop_packet(self) -> bytes:
        """A packet that sets both duties to 0: the board shorts the windings."""
        return command_packet(self.address, RoboclawCommand.DUTY_M1_M2, duty_data(0, 0))

    # ---- outside of the cycle: these wait for answers

    def identify(self) -> RoboClawIdentity:
        """Ask who it is and how it is set up. Raises BoardSilent, WrongIdentity."""
        text = self._read(RoboclawCommand.READ_FIRMWARE_VERSION, VERSION_BYTES)
        version = text.decode("ascii", errors="replace").strip("\n\0 ")
        if "claw" not in version.lower() and "mcp" not in version.lower():
            raise WrongIdentity(f"{self.where}: expected a RoboClaw or MCP controller, it says it is {version!r}")
        pins = tuple(self._read(RoboclawCommand.READ_PIN_MODES, PIN_MODE_BYTES))
        modes = struct.unpack(">BB", self._read(RoboclawCommand.READ_ENCODER_MODES, 2))
        self.found_duty = self._settled_duty()
        self.identity = RoboClawIdentity(version, pins, modes, self._pwm_idle(len(pins)))
        return self.identity

    def _settled_duty(self) -> tuple[int, int]:
        """The duties that last: questions feed its time-out, too, so what another host has left is given the time to end."""
        duties: tuple[int, int] = struct.unpack(">hh", self._read(RoboclawCommand.READ_DUTIES, 4))
        if any(duties):
            (steps,) = self._read(RoboclawCommand.READ_SERIAL_TIMEOUT, 1)
            if 0 < steps <= LONGEST_WAITED:
                clock = self._line.clock
                clock.wait_until_s(clock.now_s() + (steps + 1) * TIMEOUT_STEP_s)
                duties = struct.unpack(">hh", self._read(RoboclawCommand.READ_DUTIES, 4))
        return duties

    def _pwm_idle(self, pins: int) -> tuple[int, int]:
        """How both motors idle; only today's firmware, with more pins, is asked."""
        if pins > PIN_MODE_BYTES[0]:
            with contextlib.suppress(BoardSilent):
                first, second = self._read(RoboclawCommand.READ_PWM_IDLE, 2)
                return first, second
        return 0, 0

    def require_braking(self, channel: int) -> None:
        """WrongIdentity if the motor of a channel (1 or 2) is let go after a while at duty 0, where a loaded joint would drop."""
        if self.identity is not None and (idle := self.identity.pwm_idle[channel - 1]) & IDLES:
            raise WrongIdentity(
                f"{self.where}: expected PWM idle of motor {channel} off, it is on after {0.1 * (idle & ~IDLES):.1f} s at"
                " duty 0: its joint would drop where it is to brake; switch it off in the vendor's Motion Studio"
            )

    def require_quadrature(self, channel: int) -> None:
        """WrongIdentity unless the encoder input of a channel (1 or 2) counts quadrature edges."""
        if self.identity is not None and (mode := self.identity.encoder_modes[channel - 1]) & QUADRATURE_ONLY:
            raise WrongIdentity(
                f"{self.where}: expected a quadrature encoder at channel {channel}, its encoder mode is {mode:#04x} (absolute"
                " or analog); set it in the vendor's Motion Studio"
            )

    def require_home_switch(self, channel: int) -> None:
        """WrongIdentity unless S4, of channel 1, or S5, of channel 2, tells of a home switch."""
        self._require_pin(channel, "Home (User)", HOME_PINS)

    def require_limit_switch(self, channel: int, is_forward: bool) -> None:
        """WrongIdentity unless S4, of channel 1, or S5, of channel 2, tells of a limit switch at this end of the motor's way."""
        if is_forward:
            self._require_pin(channel, "Limit (Fwd)", (LIMIT_FORWARD, LIMIT_BOTH))
        else:
            self._require_pin(channel, "Limit (Rev)", (LIMIT_REVERSE, LIMIT_BOTH))
        self._has_limit_switch = True

    def _require_pin(self, channel: int, called: str, modes: tuple[int, ...]) -> None:
        if self.identity is not None and (mode := self.identity.pin_modes[channel]) not in modes:
            raise WrongIdentity(
                f'{self.where}: expected S{3 + channel} as "{called}" ({modes[0]:#04x}) for the switch of channel {channel}, its'
                f" mode is {mode:#04x}; set it in the vendor's Motion Studio"
            )

    def set_up(self, timeout_s: float, current_limits_A: tuple[float, float]) -> None:
        """Set time-out, current limits and the fastest change of duty, none of which survives a restart of the board.

        The time-out is rounded down to 0.1 s, and one step less where the board has that already: a board that restarts is
        recognised by its old one.
        """
        wanted = max(LEAST_TIMEOUT, math.floor(timeout_s / TIMEOUT_STEP_s + 1e-9))
        (found,) = self._read(RoboclawCommand.READ_SERIAL_TIMEOUT, 1)
        if found == wanted:
            wanted = wanted - 1 if wanted > LEAST_TIMEOUT else wanted + 1
        self._timeout = None
        identity = self.identity or self.identify()
        change = struct.pack(">I", FASTEST_DUTY_CHANGE)
        if len(identity.pin_modes) > PIN_MODE_BYTES[0]:
            change += change  # the same firmware asks for the fastest fall of the duty, too
        for channel, limit_A in enumerate(current_limits_A):
            self._command(RoboclawCommand.SET_DUTY_ACCELERATION_1 + channel, change)
            if math.isfinite(limit_A):
                self._command(RoboclawCommand.SET_CURRENT_LIMIT_1 + channel, struct.pack(">II", round(limit_A * 100), 0))
        self._command(RoboclawCommand.SET_SERIAL_TIMEOUT, bytes((wanted,)))
        self._timeout = wanted
        self.status = None  # of before a restart

    def read_counts(self) -> tuple[int, int]:
        """Both counts as they are now."""
        self.counts = pair_of_counts(self._read(RoboclawCommand.READ_ENCODERS, 8))
        return self.counts

    def read_status(self) -> RoboclawStatus:
        """The status as it is now."""
        self._take_status(self._read(RoboclawCommand.READ_STATUS, STATUS_BYTES), 0.0)
        return self.status or RoboclawStatus(0)

    def set_count(self, channel: int, count: int) -> None:
        """Set the counter of a channel, 1 or 2."""
        self._command(RoboclawCommand.SET_ENCODER_1 + channel - 1, struct.pack(">I", count & 0xFFFF_FFFF))

    def _read(self, command: int, reply_bytes: int | tuple[int, ...]) -> bytes:
        return self._line.read(self.address, command, reply_bytes, self.where)

    def _command(self, command: int, data: bytes) -> None:
        self._line.command(self.address, command, data, self.where)

    # ---- answers

    def _duty_data(self) -> bytes:
        self.sent_duty = (self.duty[0], self.duty[1])
        return duty_data(*self.sent_duty)

    def _take_duty(self, _: bytes, sent_at_s: float) -> None:
        self.obeyed_at_s = sent_at_s

    def _take_counts(self, data: bytes, sent_at_s: float) -> None:
        self.counts, self.counted_at_s = pair_of_counts(data), sent_at_s
        self.count_late_s = self._line.late_s

    def _take_currents(self, data: bytes, sent_at_s: float) -> None:
        """Currents with the sign of the motor's terminal voltage: the board says what each motor draws."""
        drawn_A, duty = pair_of_currents_A(data), self.sent_duty
        self.currents_A = (math.copysign(1.0, duty[0]) * drawn_A[0], math.copysign(1.0, duty[1]) * drawn_A[1])
        self.currents_at_s = sent_at_s

    def _take_status(self, data: bytes, _: float) -> None:
        self.status = status(data)

    def _take_supply(self, data: bytes, _: float) -> None:
        self.supply_V = tenths(data)

    def _take_temperature(self, data: bytes, _: float) -> None:
        self.temperature_degC = tenths(data)

    def _take_timeout(self, data: bytes, _: float) -> None:
        if self._timeout is not None and data[0] != self._timeout:
            self._timeout = None
            self.resets += 1
            self.problems.append(
                BoardReset(
                    f"{self.where}: restarted by itself; its counts, limits and time-out are lost: check its supply, then home"
                    " again"
                )
            )
