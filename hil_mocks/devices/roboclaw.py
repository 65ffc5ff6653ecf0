"""RoboClaw boards on a packet serial line, written from the vendor's manual ("RoboClaw Series User Manual", Basicmicro).

A board is a state machine without I/O: `receive` bytes, `tick` once per control period with the measurements, and read `duty`.
Of newer firmware it has what the vendor's client basicmicro 2.0.10 sends and reads. What these leave open is assumed: that gains
are of a share of QPPS, how many signals, streams and outputs there are, that nobody else is on its CAN bus, and what is in
docs/roboclaw.md.
"""

from __future__ import annotations

import binascii
import math
import struct
from collections.abc import Callable
from itertools import accumulate
from typing import Any

from hil_mocks.devices.servo_motor import POSITION_RATE

ACKNOWLEDGEMENT = b"\xff"
GAP_S = 0.010  # between two bytes of a packet: longer, and it is discarded
LATENCY_S = 0.0003  # from the last byte of a request to the first of its answer
FULL = 32767
E_STOP, OVER_HEATED, VOLTAGE_HIGH, VOLTAGE_LOW = 0x1, 0x2, 0x8, 0x4000
DRIVER_FAULT, OVER_CURRENT_WARNING, PIN_TRIGGERED = (0x40, 0x80), (0x10000, 0x20000), (0x400000, 0x800000)
ERRORS = 0xFFFF
LOGIC_TENTHS_V, TENTHS_DEGC = 50, 300
THERE = 4  # counts, at which a movement is over
NO_OBJECT = 0x0602_0000  # CANopen's abort code

# Settings: the command that reads them; those that set them in this order, with their bytes.
SETTINGS = {
    15: {14: 1},
    55: {28: 16},
    56: {29: 16},
    59: {57: 5},
    60: {58: 4},
    63: {61: 28},
    64: {62: 28},
    72: {70: 2, 71: 2},
    75: {74: 5},
    77: {76: 24},
    81: {68: 8, 69: 8},
    91: {92: 1, 93: 1},
    97: {96: 37},
    99: {98: 2},
    104: {102: 10},
    107: {105: 4, 106: 4},
    110: {109: 4},
    113: {112: 4},
    116: {115: 2},
    130: {128: 8},
    131: {129: 8},
    135: {133: 8},
    136: {134: 8},
    140: {139: 3},
    142: {141: 2},
    149: {148: 2},
    151: {150: 1},
    161: {160: 2},
    202: {201: 1},
    247: {246: 4},
}
LISTS = {138: (137, 2, 1), 144: (143, 8, 52), 146: (145, 3, 9)}  # read as their number and rows; set by the row's index
PLACES = {  # of what a command sets: the setting, from where, bytes
    write: (read, end - size, size)
    for read, writes in SETTINGS.items()
    for (write, size), end in zip(writes.items(), accumulate(writes.values()), strict=True)
}
GAINS = (28, 29, 61, 62)  # set as D, P, I, read as P, I, D
TIMEOUT, VOLTAGES, VELOCITY_GAINS, POSITION_GAINS, DEFAULT_SPEEDS, RATES, CURRENT_LIMITS = (15, 59, 55, 63, 72, 81, 135)
# Bits of a mode of S4 and S5, by the table of command 74: a switch that stops its motor going forward, and in reverse. Of those
# with HOME_PIN the manual says besides that the count becomes 0 (docs/roboclaw.md).
SWITCH_PIN, FORWARD_PIN, REVERSE_PIN, HOME_PIN = 0x02, 0x10, 0x20, 0x40
PIN_MODES = 75
DELIVERED = {
    **{read: bytes(sum(writes.values())) for read, writes in SETTINGS.items()},
    **{read: bytes((rows,)) + bytes(rows * size) for read, (_, rows, size) in LISTS.items()},
    TIMEOUT: b"\x0a",  # in 0.1 s; 0: none
    VELOCITY_GAINS: struct.pack(">4I", 0x10000, 0x8000, 0x4000, 44_000),
    VELOCITY_GAINS + 1: struct.pack(">4I", 0x10000, 0x8000, 0x4000, 44_000),
    VOLTAGES: struct.pack(">HHB", 60, 340, 0),  # in 0.1 V
    PIN_MODES: bytes((0, 0x62, 0x62, 0, 0)),  # S3; S4 and S5 as home switches; CTRL1, CTRL2
    RATES: struct.pack(">4I", *[655_359] * 4),  # of the duties: rise and fall
    CURRENT_LIMITS: struct.pack(">II", 6000, 0),  # in 10 mA
    CURRENT_LIMITS + 1: struct.pack(">II", 6000, 0),
}

# Movements: what each command carries of motor 0, of motor 1 and of both (2), in its order: duty u, percent of the
# way %, speed v, acceleration a, deceleration f, distance d, position p, whether it goes before what waits b.
MOVEMENTS = {
    32: "0u",
    33: "1u",
    34: "0u1u",
    35: "0v",
    36: "1v",
    37: "0v1v",
    38: "0av",
    39: "1av",
    40: "2a0v1v",
    41: "0vdb",
    42: "1vdb",
    43: "0vd1vd2b",
    44: "0avdb",
    45: "1avdb",
    46: "2a0vd1vd2b",
    50: "0av1av",
    51: "0avd1avd2b",
    52: "0ua",
    53: "1ua",
    54: "0ua1ua",
    65: "0avfpb",
    66: "1avfpb",
    67: "0avfp1avfp2b",
    119: "0pb",
    120: "1pb",
    121: "0p1p2b",
    122: "0vpb",
    123: "1vpb",
    124: "0vp1vp2b",
    125: "0%b",
    126: "1%b",
    127: "0%1%2b",
}
TYPES = dict(zip("u%vafdpb", "hhiIIIiB", strict=True))
FORMATS = {
    command: ">" + "".join(TYPES[letter] for letter in carried if letter in TYPES) for command, carried in MOVEMENTS.items()
}
# What is set or done besides; all commands that are not written read.
WRITES = (
    {20: 0, 22: 4, 23: 4, 80: 4, 94: 4, 95: 0, 181: 12, 190: 9, 200: 0, 248: 0, 249: 0, 253: 3}
    | {write: size for write, (_, _, size) in PLACES.items()}
    | {write: 1 + size for write, _, size in LISTS.values()}
    | {command: struct.calcsize(layout) for command, layout in FORMATS.items()}
)
ASKED = {191: 4, 252: 1}  # bytes of what a question asks for
SAID: dict[int, tuple[str, Callable[[RoboClawMock], tuple[int, ...]]]] = {
    16: (">IB", lambda board: (board.count(0), 0)),
    17: (">IB", lambda board: (board.count(1), 0)),
    **dict.fromkeys((18, 30), (">iB", lambda board: (board.speeds[0], board.speeds[0] < 0))),
    **dict.fromkeys((19, 31), (">iB", lambda board: (board.speeds[1], board.speeds[1] < 0))),
    24: (">H", lambda board: (board.tenths_V,)),
    25: (">H", lambda board: (LOGIC_TENTHS_V,)),
    47: (">BB", lambda board: (board.waiting(0), board.waiting(1))),
    48: (">hh", lambda board: board.duties),
    49: (">hh", lambda board: board.drawn),
    73: (">IIHHHHhhhhIIiiiiHHHH", lambda board: board.everything),
    78: (">II", lambda board: (board.count(0), board.count(1))),
    **dict.fromkeys((79, 108), (">ii", lambda board: board.speeds)),
    **dict.fromkeys((82, 83), (">H", lambda board: (TENTHS_DEGC,))),
    90: (">I", lambda board: (board.status,)),
    100: (">HH", lambda board: (board.tenths_V, LOGIC_TENTHS_V)),
    101: (">HH", lambda board: (TENTHS_DEGC, TENTHS_DEGC)),
    103: (">BB", lambda board: (0, 0)),
    111: (">HH", lambda board: board.errors("v")),
    114: (">HH", lambda board: board.errors("p")),
    147: (">41B", lambda board: (2, *bytes(40))),
    180: (">I", lambda board: (0,)),
}
LENGTHS = {command: 2 + ASKED.get(command, 0) for command in (21, 182, *ASKED, *SAID, *DELIVERED)} | {
    command: 4 + size for command, size in WRITES.items()
}
# The manual of 2017 ends earlier, and some of its packets do.
OLDER = {*range(14, 70), *range(74, 84), *range(90, 96), 98, 99, *range(133, 137), 148, 149}
OLDER_LENGTHS = {command: length for command, length in LENGTHS.items() if command in OLDER} | {57: 8, 68: 8, 69: 8, 74: 7, 94: 4}
OLDER_ANSWERS = {59: 4, 75: 3}


def crc16(data: bytes) -> int:
    """The manual's CRC: polynomial 0x1021 from 0."""
    return binascii.crc_hqx(data, 0)


def _signed(number: int) -> int:
    return (number + 0x8000_0000) % 0x1_0000_0000 - 0x8000_0000


Movement = dict[str, int]
"""By the letters of `MOVEMENTS`."""


class RoboClawMock:
    """One board. `read_shaft(channel)` gives the edges counted by an encoder input, without wrap; channels 0 and 1.

    `settings`: by the command that reads them, as it answers; `saved`: what command 94 saves, and a restart brings back.
    """

    version = "RoboClaw 2x15A v4.3.6"

    def __init__(
        self, address: int, read_shaft: Callable[[int], int], has_ctrl_pins: bool = True, has_short_status: bool = False
    ) -> None:
        """`has_ctrl_pins`: its firmware is today's, and not that of the manual of 2017. `has_short_status`: it is older still."""
        self.address, self._has_short_status = address, has_short_status
        self.is_older = not has_ctrl_pins
        self.saved = dict(DELIVERED)
        self.eeprom: dict[int, int] = {}
        self.objects: dict[bytes, tuple[int, int]] = {}  # of CANopen, by node, index and subindex: value, size
        self.can_sent: list[bytes] = []
        self.can_heard: list[bytes] = []
        self.forced_errors = 0  # persistent causes, set by a fault of the scenario
        self.stuck: dict[int, int] = {}  # channel: the count at which its input stands still
        self.are_switches_on = [False, False]
        self._read_shaft = read_shaft
        self.power_up()

    def be_of_older_firmware(self) -> None:
        """As if it had been flashed: of before the manual of 2017."""
        self.is_older = self._has_short_status = True

    def power_up(self) -> None:
        """State after power-up or a restart: duties and counts 0, settings as saved."""
        self.settings = dict(self.saved)
        self.duty = [0.0, 0.0]  # applied, ramped towards what is wanted
        self.movements: list[Movement] = [{"u": 0}, {"u": 0}]
        self.queues: list[list[Movement]] = [[], []]
        self._offsets = [-self._shaft(channel) for channel in (0, 1)]
        self._shafts = [self._shaft(channel) for channel in (0, 1)]
        self._starts = [0, 0]  # counts at which the movements began
        self._set_speeds = [0.0, 0.0]  # counts/s, of the profile
        self._integrals = [0.0, 0.0]
        self.speeds: tuple[int, int] = (0, 0)  # counts/s
        self._currents = [0.0, 0.0]
        self._is_limited = [False, False]
        self._supply_V = 24.0
        self._obeyed_s = self._ticked_s = 0.0

    def _shaft(self, channel: int) -> int:
        return self.stuck.get(channel, self._read_shaft(channel))

    # ---- what it tells

    def count(self, channel: int) -> int:
        """The counter of a channel, 32 bits."""
        return (self._shaft(channel) + self._offsets[channel]) & 0xFFFF_FFFF

    @property
    def tenths_V(self) -> int:
        """The main supply."""
        return round(self._supply_V * 10)

    @property
    def duties(self) -> tuple[int, int]:
        """As they are applied."""
        return round(self.duty[0]), round(self.duty[1])

    @property
    def current_limits_A(self) -> tuple[float, float]:
        """Of the motors."""
        first, second = (int.from_bytes(self.settings[CURRENT_LIMITS + channel][:4], "big") for channel in (0, 1))
        return first * 0.01, second * 0.01

    @property
    def drawn(self) -> tuple[int, ...]:
        """What the motors draw in 10 mA: positive while they drive, negative while they feed back."""
        signs = (-1.0 if duty < 0.0 else 1.0 for duty in self.duty)
        return tuple(round(sign * one * 100) for sign, one in zip(signs, self._currents, strict=True))

    @property
    def status(self) -> int:
        """The 32 bits of command 90."""
        low, high, _ = struct.unpack(">HHB", self.settings[VOLTAGES])
        bits = self.forced_errors
        bits |= (VOLTAGE_LOW if self.tenths_V < low else 0) | (VOLTAGE_HIGH if self.tenths_V > high else 0)
        for channel in (0, 1):
            bits |= OVER_CURRENT_WARNING[channel] if self._is_limited[channel] else 0
            bits |= PIN_TRIGGERED[channel] if self.are_switches_on[channel] else 0
        return bits

    def _short_status(self) -> int:
        """The 16 bits of older firmware, of what this board can have."""
        old = {
            E_STOP: 0x4,
            OVER_HEATED: 0x8,
            VOLTAGE_HIGH: 0x20,
            **dict(zip(DRIVER_FAULT, (0x100, 0x200), strict=True)),
            **dict(zip(OVER_CURRENT_WARNING, (0x1, 0x2), strict=True)),
            VOLTAGE_LOW: 0x800,
            **dict(zip(PIN_TRIGGERED, (0x4000, 0x8000), strict=True)),
        }
        return sum(short for bit, short in old.items() if self.status & bit)

    @property
    def everything(self) -> tuple[int, ...]:
        """Command 73."""
        return (
            round(self._ticked_s * 1e3) & 0xFFFF_FFFF,
            self.status,
            TENTHS_DEGC,
            TENTHS_DEGC,
            self.tenths_V,
            LOGIC_TENTHS_V,
            *self.duties,
            *self.drawn,
            self.count(0),
            self.count(1),
            0,
            0,
            *self.speeds,
            *self.errors("v"),
            *self.errors("p"),
        )

    def waiting(self, channel: int) -> int:
        """How many movements wait behind the one that lasts; 0x80: none lasts."""
        return len(self.queues[channel]) if self.queues[channel] or abs(self._left(channel)) > THERE else 0x80

    def errors(self, of: str) -> tuple[int, ...]:
        """How far speed or position is from what is wanted, where a movement has one."""
        speeds = zip(self._set_speeds, self.speeds, strict=True)
        off = [wanted - speed for wanted, speed in speeds] if of == "v" else map(self._left, (0, 1))
        moved = zip(self.movements, off, strict=True)
        return tuple(0 if "u" in movement else min(round(abs(one or 0)), 0xFFFF) for movement, one in moved)

    # ---- control

    def tick(self, now_s: float, currents_A: list[float], supply_V: float, is_limited: list[bool]) -> None:
        """Run one control period: measure, watch the time-out, and control the duties."""
        step_s, self._ticked_s = now_s - self._ticked_s, now_s
        self._currents, self._supply_V, self._is_limited = currents_A, supply_V, is_limited
        timeout_s = self.settings[TIMEOUT][0] * 0.1
        if timeout_s and now_s - self._obeyed_s > timeout_s:
            self.movements, self.queues = [{"u": 0}, {"u": 0}], [[], []]
        before, self._shafts = self._shafts, [self._shaft(channel) for channel in (0, 1)]
        rates = [(now - then) / step_s if step_s > 0.0 else 0.0 for now, then in zip(self._shafts, before, strict=True)]
        self.speeds = (round(rates[0]), round(rates[1]))
        is_stopped = bool(self.status & ERRORS)
        for channel in (0, 1):
            movement = self._movement(channel)
            if is_stopped or "u" in movement:
                self._ramp(channel, 0 if is_stopped else movement["u"], movement.get("a", 0), step_s)
                self._set_speeds[channel] = self._integrals[channel] = 0.0
            else:
                self.duty[channel] = self._controlled(channel, movement, step_s)
            if self._is_barred(channel):
                self.duty[channel] = 0.0

    def _is_barred(self, channel: int) -> bool:
        """Whether it drives into its limit switch."""
        mode = self.settings[PIN_MODES][1 + channel]
        way = FORWARD_PIN if self.duty[channel] > 0.0 else REVERSE_PIN
        is_limit = bool(mode & SWITCH_PIN) and not mode & HOME_PIN
        return self.are_switches_on[channel] and is_limit and bool(mode & way)

    def _ramp(self, channel: int, wanted: int, own_rate: int, step_s: float) -> None:
        """The duty goes to the wanted one."""
        change = wanted - self.duty[channel]
        is_falling = change * self.duty[channel] < 0.0
        rates = struct.unpack_from(">II", self.settings[RATES], 8 * channel)
        most = (own_rate or rates[is_falling]) * step_s
        self.duty[channel] += min(max(change, -most), most)

    def _movement(self, channel: int) -> Movement:
        """The one that lasts: one that is over is followed by the next."""
        while self.queues[channel] and abs(self._left(channel)) <= THERE:
            self.movements[channel] = self.queues[channel].pop(0)
            self._starts[channel] = self.count(channel)
        return self.movements[channel]

    def _left(self, channel: int) -> int:
        """Counts to the end of the movement, 0 for one without an end, or that is there."""
        movement, count = self.movements[channel], self.count(channel)
        if "d" in movement:
            passed = _signed(count - self._starts[channel])
            way = math.copysign(movement["d"], movement["v"])
            return int(way - passed) if abs(passed) < movement["d"] else 0
        if "%" in movement:
            lowest, highest = struct.unpack_from(">ii", self.settings[POSITION_GAINS + channel], 20)
            return _signed(round(lowest + (highest - lowest) * (movement["%"] / FULL + 1.0) / 2.0) - count)
        return _signed(movement["p"] - count) if "p" in movement else 0

    def _controlled(self, channel: int, movement: Movement, step_s: float) -> float:
        """The duty that makes the motor follow its speed, which is 0 at the end of the way."""
        p, i, _, most = struct.unpack(">4I", self.settings[VELOCITY_GAINS + channel])
        (default,) = struct.unpack_from(">H", self.settings[DEFAULT_SPEEDS], 2 * channel)
        wanted = float(movement.get("v", default) or most)
        if not movement.keys().isdisjoint("dp%"):
            way_counts = self._left(channel)
            slowing = movement.get("f", movement.get("a", 0)) or math.inf
            top = math.sqrt(2.0 * slowing * abs(way_counts)) if way_counts else 0.0
            wanted = math.copysign(min(abs(wanted), POSITION_RATE * abs(way_counts), top), way_counts)
        faster = (movement.get("a", 0) or math.inf) * step_s
        self._set_speeds[channel] += min(max(wanted - self._set_speeds[channel], -faster), faster)
        error = self._set_speeds[channel] - self.speeds[channel]
        corrected = self._set_speeds[channel] + (p * error + i * self._integrals[channel]) / 0x10000
        share: float = corrected / max(most, 1)
        if abs(share) < 1.0:
            self._integrals[channel] += error * step_s
        return FULL * min(max(share, -1.0), 1.0)

    # ---- packets

    def obey(self, packet: bytes, now_s: float) -> bytes:
        """The answer to a whole, valid packet for this board, after having obeyed it."""
        self._obeyed_s = now_s
        command = packet[1]
        if command in WRITES:
            return ACKNOWLEDGEMENT + self._obey(command, packet[2:-2])
        data = self._said(command, packet[2:])
        return data + struct.pack(">H", crc16(packet + data))

    def _said(self, command: int, asked: bytes) -> bytes:
        if command == 21:
            return self.version.encode("ascii") + b"\n\0"
        if command == 90 and self._has_short_status:
            return struct.pack(">H", self._short_status())
        if command == 182:
            return b"\xff" + self.can_heard.pop(0) if self.can_heard else bytes(13)
        if command == 191:
            value, size = self.objects.get(asked, (0, 0))
            return struct.pack(">IBBI", value, size, 0, 0 if asked in self.objects else NO_OBJECT)
        if command == 252:
            return struct.pack(">H", self.eeprom.get(asked[0], 0xFFFF))
        if command in self.settings:
            return self.settings[command][: OLDER_ANSWERS.get(command) if self.is_older else None]
        layout, values = SAID[command]
        return struct.pack(layout, *values(self))

    def _obey(self, command: int, data: bytes) -> bytes:
        """What follows the acknowledgement is nearly always nothing."""
        settings = self.settings
        if command in MOVEMENTS:
            self._move(MOVEMENTS[command], struct.unpack(FORMATS[command], data))
        elif command in PLACES:
            read, at, size = PLACES[command]
            data = data[4:12] + data[:4] + data[12:] if command in GAINS else data
            if command in (68, 69):
                data = (data * 2)[:size]  # older firmware: one rate for both
            settings[read] = settings[read][:at] + data + settings[read][at + len(data) :]
        match command:
            case 137 | 143 | 145:
                size, before = len(data) - 1, settings[command + 1]
                at = 1 + data[0] * size
                settings[command + 1] = (before[:at] + data[1:] + before[at + size :])[: len(before)]
            case 20:
                self._offsets = [-self._shaft(channel) for channel in (0, 1)]
            case 22 | 23:
                self._offsets[command - 22] = int.from_bytes(data, "big") - self._shaft(command - 22)
            case 80:
                self.saved = dict(DELIVERED)
                self.settings = dict(DELIVERED)
            case 94:
                self.saved = dict(settings)
            case 95:
                self.settings = dict(self.saved)
            case 181:
                self.can_sent.append(data)
            case 190:
                self.objects[data[:4]] = (int.from_bytes(data[4:8], "big"), data[8])
                return bytes(4) + struct.pack(">H", crc16(bytes(4)))
            case 200:
                self.forced_errors &= ~E_STOP
            case 253:
                self.eeprom[data[0]] = int.from_bytes(data[1:], "big")
        return b""

    def _move(self, carried: str, values: tuple[Any, ...]) -> None:
        """Begin a movement, or let it wait for the end of the one that lasts."""
        commanded: dict[int, Movement] = {}
        operands = iter(values)
        channels: tuple[int, ...] = ()
        for letter in carried:
            if letter.isdigit():
                channels = ((0,), (1,), (0, 1))[int(letter)]
                continue
            value = next(operands)
            for channel in channels:
                commanded.setdefault(channel, {})[letter] = value
        for channel, movement in commanded.items():
            if movement.pop("b", 1):
                self.queues[channel].clear()
                self.movements[channel], self._starts[channel] = movement, self.count(channel)
            else:
                self.queues[channel].append(movement)


class RoboClawLineMock:
    """A line with boards: every board hears all bytes and answers packets with its address; the answers take their time."""

    def __init__(self, boards: list[RoboClawMock], baud: int) -> None:
        self.boards = {board.address: board for board in boards}
        self.outgoing: list[tuple[float, bytes]] = []  # (arrival at the host, bytes)
        self._byte_s = 10.0 / baud
        self._packet = b""
        self._heard_s = 0.0
        self._is_deaf = False  # until a gap, after a command whose length is unknown

    def receive(self, received: bytes, now_s: float) -> None:
        """Bytes from the host."""
        if now_s - self._heard_s > GAP_S:
            self._packet, self._is_deaf = b"", False
        self._heard_s = now_s
        if self._is_deaf:
            return
        self._packet += received
        while (length := self._length()) is not None and len(self._packet) >= length:
            packet, self._packet = self._packet[:length], self._packet[length:]
            self._take(packet, now_s)

    def _length(self) -> int | None:
        """Length of the packet that begins here, once it is known."""
        if len(self._packet) < 2:
            return None
        address, command = self._packet[0], self._packet[1]
        board = self.boards.get(address)
        lengths = OLDER_LENGTHS if board is not None and board.is_older else LENGTHS
        if not 0x80 <= address <= 0x87 or command not in lengths:
            self._packet, self._is_deaf = b"", True
            return None
        return lengths[command]

    def _take(self, packet: bytes, now_s: float) -> None:
        board = self.boards.get(packet[0])
        if board is None:
            return
        if packet[1] in WRITES and crc16(packet[:-2]) != int.from_bytes(packet[-2:], "big"):
            return  # invalid: no answer
        answer = board.obey(packet, now_s)
        there_s = now_s + LATENCY_S + (len(packet) + len(answer)) * self._byte_s
        self.outgoing.append((there_s, answer))
