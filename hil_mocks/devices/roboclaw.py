"""RoboClaw boards on a packet serial line, written from the vendor's manual ("RoboClaw Series User Manual", Basicmicro).

A board is a state machine without I/O: `receive` bytes, `tick` once per control period with the measurements, and read `duty`.
What the manual leaves open, and what is assumed here, is in docs/roboclaw.md.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Callable
from dataclasses import dataclass, field

ACKNOWLEDGEMENT = b"\xff"
GAP_S = 0.010  # between two bytes of a packet: longer, and it is discarded
LATENCY_S = 0.0003  # from the last byte of a request to the first of its answer
FULL = 32767
E_STOP, OVER_HEATED, VOLTAGE_HIGH, VOLTAGE_LOW = 0x1, 0x2, 0x8, 0x4000
DRIVER_FAULT, OVER_CURRENT_WARNING, PIN_TRIGGERED = (0x40, 0x80), (0x10000, 0x20000), (0x400000, 0x800000)
ERRORS = 0xFFFF

# Bytes of data of the commands that set or command something; all others here read.
WRITES = {
    14: 1, 20: 0, 22: 4, 23: 4, 32: 2, 33: 2, 34: 4, 57: 4, 68: 4, 69: 4, 74: 3, 92: 1, 93: 1, 94: 0, 133: 8, 134: 8, 200: 0,
}  # fmt: skip
# Today's firmware, as the vendor's client basicmicro 2.0.10 speaks with it: rise and fall of the duty, and the pins CTRL1, CTRL2.
CTRL_WRITES = {**WRITES, 68: 8, 69: 8, 74: 5, 160: 2}
READS = {15, 16, 17, 21, 24, 25, 48, 49, 59, 75, 78, 82, 90, 91, 135, 136}
CTRL_READS = READS | {161}
# What the vendor's client sets and reads back of the board's own loops, pins and limits, which nothing here moves by: the command
# that sets it, its bytes, the command that reads it, and where it stands there.
KEPT = {
    28: (16, 55, 0), 29: (16, 56, 0), 58: (4, 60, 0), 61: (28, 63, 0), 62: (28, 64, 0), 70: (2, 72, 0), 71: (2, 72, 2),
    76: (24, 77, 0), 98: (2, 99, 0), 102: (10, 104, 0), 105: (4, 107, 0), 106: (4, 107, 4), 109: (4, 110, 0), 112: (4, 113, 0),
    115: (2, 116, 0), 128: (8, 130, 0), 129: (8, 131, 0), 139: (3, 140, 0), 141: (2, 142, 0), 148: (2, 149, 0),
    150: (1, 151, 0), 201: (1, 202, 0), 246: (4, 247, 0),
}  # fmt: skip
GAINS = (28, 29, 61, 62)  # set as D, P, I, read as P, I, D
KEPT_BYTES = {
    read: max(at + size for size, where, at in KEPT.values() if where == read) for _, read, _ in KEPT.values()
}
CTRL_WRITES |= {52: 6, 53: 6, 54: 12, 80: 4, 94: 4, 95: 0} | {
    command: size for command, (size, _, _) in KEPT.items()
}
CTRL_READS |= {18, 19, 30, 31, 47, 72, 73, 79, 81, 83, 100, 101, 103, 108, 111, 114} | KEPT_BYTES.keys()


def crc16(data: bytes) -> int:
    """The manual's CRC: polynomial 0x1021 from 0."""
    return binascii.crc_hqx(data, 0)


@dataclass(slots=True)
class StoredSettings:
    """What command 94 saves, and what a restart brings back."""

    timeout: int = 10  # in 0.1 s; 0: none
    duty_accelerations: list[int] = field(default_factory=lambda: [655359, 655359])
    current_limits: list[int] = field(default_factory=lambda: [6000, 6000])  # in 10 mA
    duty_falls: list[int] = field(default_factory=lambda: [655359, 655359])
    pin_modes: tuple[int, ...] = (0, 0x62, 0x62, 0, 0)  # S3; S4 and S5 as home switches; CTRL1, CTRL2
    encoder_modes: list[int] = field(default_factory=lambda: [0, 0])
    main_voltages: tuple[int, int] = (60, 340)  # in 0.1 V
    pwm_idle: bytes = bytes(2)  # of both motors: 0x80, and a delay in 0.1 s
    kept: dict[int, bytes] = field(
        default_factory=lambda: {read: bytes(size) for read, size in KEPT_BYTES.items()}
    )

    def copy(self) -> StoredSettings:
        """A copy that shares nothing."""
        return StoredSettings(
            self.timeout, list(self.duty_accelerations), list(self.current_limits), list(self.duty_falls),
            self.pin_modes, list(self.encoder_modes), self.main_voltages, self.pwm_idle, dict(self.kept),
        )  # fmt: skip


class RoboClawMock:
    """One board. `read_shaft(channel)` gives the edges counted by an encoder input, without wrap; channels 0 and 1."""

    version = "RoboClaw 2x15A v4.3.6"

    def __init__(
        self, address: int, read_shaft: Callable[[int], int], has_ctrl_pins: bool = True, has_short_status: bool = False
    ) -> None:  # fmt: skip
        """`has_ctrl_pins`: its firmware is today's, and not that of the manual of 2017. `has_short_status`: it is older still."""
        self._has_short_status = has_short_status
        self.address = address
        self.writes = CTRL_WRITES if has_ctrl_pins else WRITES
        self.reads = CTRL_READS if has_ctrl_pins else READS
        self.saved = StoredSettings()
        if not has_ctrl_pins:
            self.saved.pin_modes = self.saved.pin_modes[:3]
        self.forced_errors = 0  # persistent causes, set by a fault of the scenario
        self.stuck: dict[int, int] = {}  # channel: the count at which its input stands still
        self.are_switches_on = [False, False]
        self._read_shaft = read_shaft
        self.power_up()

    def be_of_older_firmware(self) -> None:
        """As if it had been flashed: of before the manual of 2017."""
        self.writes, self.reads, self._has_short_status = WRITES, READS, True
        for settings in (self.saved, self.settings):
            settings.pin_modes = settings.pin_modes[:3]

    def power_up(self) -> None:
        """State after power-up or a restart: duties and counts 0, settings as saved."""
        self.settings = self.saved.copy()
        self.duty = [0.0, 0.0]  # applied, ramped towards `wanted_duty`
        self.wanted_duty = [0, 0]
        self._changes: list[int | None] = [None, None]  # of the duty, with which it was commanded
        self._speeds = [0, 0]  # counts/s
        self._offsets = [-self._shaft(channel) for channel in (0, 1)]
        self._shafts = [self._shaft(channel) for channel in (0, 1)]
        self._currents = [0.0, 0.0]
        self._is_limited = [False, False]
        self._supply_V = 24.0
        self._is_driven = False
        self._obeyed_s = self._ticked_s = 0.0

    def _shaft(self, channel: int) -> int:
        return self.stuck.get(channel, self._read_shaft(channel))

    def count(self, channel: int) -> int:
        """The counter of a channel, 32 bits."""
        return (self._shaft(channel) + self._offsets[channel]) & 0xFFFF_FFFF

    @property
    def status(self) -> int:
        """The 32 bits of command 90."""
        low, high = self.settings.main_voltages
        tenths = round(self._supply_V * 10)
        bits = self.forced_errors
        bits |= (VOLTAGE_LOW if tenths < low else 0) | (VOLTAGE_HIGH if tenths > high else 0)
        for channel in (0, 1):
            bits |= OVER_CURRENT_WARNING[channel] if self._is_limited[channel] else 0
            bits |= PIN_TRIGGERED[channel] if self.are_switches_on[channel] else 0
        return bits

    def _short_status(self) -> int:
        """The 16 bits of older firmware, of what this board can have."""
        old = {
            E_STOP: 0x4, OVER_HEATED: 0x8, VOLTAGE_HIGH: 0x20, **dict(zip(DRIVER_FAULT, (0x100, 0x200), strict=True)),
            **dict(zip(OVER_CURRENT_WARNING, (0x1, 0x2), strict=True)), VOLTAGE_LOW: 0x800,
            **dict(zip(PIN_TRIGGERED, (0x4000, 0x8000), strict=True)),
        }  # fmt: skip
        return sum(short for bit, short in old.items() if self.status & bit)

    def tick(self, now_s: float, currents_A: list[float], supply_V: float, is_limited: list[bool]) -> None:
        """Run one control period: measure, watch the time-out, and ramp the duties."""
        step_s, self._ticked_s = now_s - self._ticked_s, now_s
        self._currents, self._supply_V, self._is_limited = currents_A, supply_V, is_limited
        timeout_s = self.settings.timeout * 0.1
        if timeout_s and now_s - self._obeyed_s > timeout_s:
            self.wanted_duty = [0, 0]
        is_stopped = bool(self.status & ERRORS)
        for channel in (0, 1):
            shaft, self._shafts[channel] = self._shafts[channel], self._shaft(channel)
            self._speeds[channel] = round((self._shafts[channel] - shaft) / step_s) if step_s > 0.0 else 0
            wanted = 0 if is_stopped else self.wanted_duty[channel]
            change = wanted - self.duty[channel]
            is_falling = change * self.duty[channel] < 0.0
            rates = self.settings.duty_falls if is_falling else self.settings.duty_accelerations
            most = (self._changes[channel] or rates[channel]) * step_s
            self.duty[channel] += min(max(change, -most), most)

    def obey(self, packet: bytes, now_s: float) -> bytes:
        """The answer to a whole, valid packet for this board, after having obeyed it."""
        self._obeyed_s = now_s
        command = packet[1]
        if command in self.writes:
            self._set(command, packet[2:-2])
            return ACKNOWLEDGEMENT
        data = self._said(command)
        return data + struct.pack(">H", crc16(packet + data))

    def _said(self, command: int) -> bytes:
        settings = self.settings
        match command:
            case 15:
                return bytes((settings.timeout,))
            case 16 | 17:
                return struct.pack(">IB", self.count(command - 16), 0)
            case 21:
                return self.version.encode("ascii") + b"\n\0"
            case 24:
                return struct.pack(">H", round(self._supply_V * 10))
            case 25:
                return struct.pack(">H", 50)
            case 48:
                return struct.pack(">hh", *(round(duty) for duty in self.duty))
            case 49:
                return struct.pack(">hh", *(self._drawn(channel) for channel in (0, 1)))
            case 59:
                return struct.pack(">HH", *settings.main_voltages)
            case 75:
                return bytes(settings.pin_modes)
            case 78:
                return struct.pack(">II", self.count(0), self.count(1))
            case 82 | 83:
                return struct.pack(">H", 300)
            case 90:
                return (
                    struct.pack(">H", self._short_status())
                    if self._has_short_status
                    else struct.pack(">I", self.status)
                )
            case 91:
                return bytes(settings.encoder_modes)
            case 161:
                return settings.pwm_idle
            case _ if command in settings.kept:
                return settings.kept[command]
            case 18 | 19 | 30 | 31:
                speed = self._speeds[command % 6 if command < 20 else command - 30]
                return struct.pack(">iB", speed, speed < 0)
            case 79 | 108:
                return struct.pack(">ii", *self._speeds)
            case 47:
                return b"\x80\x80"  # no movement waits
            case 73:
                duties = (round(duty) for duty in self.duty)
                currents = (self._drawn(channel) for channel in (0, 1))
                volts = (round(self._supply_V * 10), 50)
                return struct.pack(
                    ">IIHHHHhhhhIIiiiiHHHH", round(self._ticked_s * 1e3) & 0xFFFF_FFFF, self.status, 300, 300, *volts, *duties,
                    *currents, self.count(0), self.count(1), 0, 0, *self._speeds, 0, 0, 0, 0,
                )  # fmt: skip
            case 81:
                pairs = zip(settings.duty_accelerations, settings.duty_falls, strict=True)
                return b"".join(struct.pack(">II", rise, fall) for rise, fall in pairs)
            case 100:
                return struct.pack(">HH", round(self._supply_V * 10), 50)
            case 101:
                return struct.pack(">HH", 300, 300)
            case 103:
                return bytes(2)
            case 111 | 114:
                return bytes(4)
            case _:  # 135, 136
                return struct.pack(">II", settings.current_limits[command - 135], 0)

    def _set(self, command: int, data: bytes) -> None:
        settings = self.settings
        if command in (32, 33, 34):
            self._changes = [None, None]
        match command:
            case _ if command in KEPT:
                size, read, at = KEPT[command]
                data = data[4:12] + data[:4] + data[12:] if command in GAINS else data
                settings.kept[read] = settings.kept[read][:at] + data + settings.kept[read][at + size :]
            case 52 | 53:
                self.wanted_duty[command - 52], self._changes[command - 52] = struct.unpack(">hI", data)
            case 54:
                first, first_change, second, second_change = struct.unpack(">hIhI", data)
                self.wanted_duty, self._changes = [first, second], [first_change, second_change]
            case 80:
                self.saved = StoredSettings()
                self.settings = self.saved.copy()
            case 95:
                self.settings = self.saved.copy()
            case 14:
                settings.timeout = data[0]
            case 20:
                self._offsets = [-self._shaft(channel) for channel in (0, 1)]
            case 22 | 23:
                (count,) = struct.unpack(">I", data)
                self._offsets[command - 22] = count - self._shaft(command - 22)
            case 32 | 33:
                (self.wanted_duty[command - 32],) = struct.unpack(">h", data)
            case 34:
                self.wanted_duty = list(struct.unpack(">hh", data))
            case 57:
                low, high = struct.unpack(">HH", data)
                settings.main_voltages = (low, high)
            case 68 | 69:
                settings.duty_accelerations[command - 68] = int.from_bytes(data[:4], "big")
                settings.duty_falls[command - 68] = int.from_bytes(data[-4:], "big")
            case 74:
                settings.pin_modes = tuple(data)
            case 92 | 93:
                settings.encoder_modes[command - 92] = data[0]
            case 94:
                self.saved = settings.copy()
            case 160:
                settings.pwm_idle = data
            case 133 | 134:
                settings.current_limits[command - 133], _ = struct.unpack(">II", data)
            case _:  # 200
                self.forced_errors &= ~E_STOP

    def _drawn(self, channel: int) -> int:
        """What the motor draws in 10 mA: positive while it drives, negative while it feeds back."""
        sign = -1.0 if self.duty[channel] < 0.0 else 1.0
        return round(sign * self._currents[channel] * 100)


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
        writes, reads = (CTRL_WRITES, CTRL_READS) if board is None else (board.writes, board.reads)
        if not 0x80 <= address <= 0x87 or (command not in writes and command not in reads):
            self._packet, self._is_deaf = b"", True
            return None
        return 2 if command in reads else 4 + writes[command]

    def _take(self, packet: bytes, now_s: float) -> None:
        board = self.boards.get(packet[0])
        if board is None:
            return
        if packet[1] in CTRL_WRITES and crc16(packet[:-2]) != int.from_bytes(packet[-2:], "big"):
            return  # invalid: no answer
        answer = board.obey(packet, now_s)
        there_s = now_s + LATENCY_S + (len(packet) + len(answer)) * self._byte_s
        self.outgoing.append((there_s, answer))
