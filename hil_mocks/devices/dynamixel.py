"""Dynamixel X servos on a half-duplex line, written from the ROBOTIS e-Manual (protocol 2.0).

A servo is a control table with a position loop behind it; without I/O: `receive` bytes, `tick` once per control period. It
has no indirect addresses. Of several servos that are read at once each waits for the one before it: after a silent one
nobody answers. Its control table is that of an XM430: what may be written, its range, and its value at delivery.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from hil_mocks.devices.motor_inputs import OPEN
from hil_mocks.devices.servo_motor import ServoMotor

RANGE_ERROR, LENGTH_ERROR, LIMIT_ERROR, ACCESS_ERROR = 0x04, 0x05, 0x06, 0x07
STORED_END, TABLE_BYTES = 64, 147  # what is below is kept without supply
RETURN_DELAY, MODE, MAX_VOLTAGE, MIN_VOLTAGE, CURRENT_LIMIT = 9, 11, 32, 34, 38
MAX_POSITION, MIN_POSITION, STARTUP, SHUTDOWN = 48, 52, 60, 63
TORQUE, RETURN_LEVEL, REGISTERED, ERROR_STATUS, WATCHDOG = 64, 68, 69, 70, 98
GOALS, GOAL_CURRENT, GOAL, VALUES = (100, 102, 104, 116), 102, 116, 126
GOAL_PWM, FULL_PWM = 100, 885
POSITION, EXTENDED, CURRENT_BASED = 3, 4, 5  # operating modes
WATCHDOG_EXPIRED = 0xFF
_TURNS_RANGE = 1_048_575  # of a goal position, but in the mode of one turn


class Item(NamedTuple):
    """What may be written at an address: bytes, lowest and highest value, value at delivery or power-up."""

    size: int
    lowest: int
    highest: int
    initial: int = 0


_GAIN = Item(2, 0, 16_383)
ITEMS = {
    7: Item(1, 0, 252, 1),
    8: Item(1, 0, 7, 1),
    RETURN_DELAY: Item(1, 0, 254, 250),
    10: Item(1, 0, 13),
    MODE: Item(1, 0, 16, POSITION),
    12: Item(1, 0, 255, 255),
    13: Item(1, 1, 2, 2),
    20: Item(4, -1_044_479, 1_044_479),
    24: Item(4, 0, 1023, 10),
    31: Item(1, 0, 100, 80),
    MAX_VOLTAGE: Item(2, 95, 160, 160),
    MIN_VOLTAGE: Item(2, 95, 160, 95),
    36: Item(2, 0, 885, 885),
    CURRENT_LIMIT: Item(2, 0, 1193, 1193),
    44: Item(4, 0, 1023, 350),
    MAX_POSITION: Item(4, 0, 4095, 4095),
    MIN_POSITION: Item(4, 0, 4095),
    STARTUP: Item(1, 0, 3),
    SHUTDOWN: Item(1, 0, 255, 52),
    TORQUE: Item(1, 0, 1),
    65: Item(1, 0, 1),
    RETURN_LEVEL: Item(1, 0, 2, 2),
    76: _GAIN._replace(initial=1920),
    78: _GAIN._replace(initial=100),
    80: _GAIN,
    82: _GAIN,
    84: _GAIN._replace(initial=800),
    88: _GAIN,
    90: _GAIN,
    WATCHDOG: Item(1, 0, 127),
    GOAL_PWM: Item(2, -FULL_PWM, FULL_PWM, FULL_PWM),
    GOAL_CURRENT: Item(2, -1193, 1193, 1193),
    104: Item(4, -1023, 1023),
    108: Item(4, 0, 32_767),
    112: Item(4, 0, 32_767),
    GOAL: Item(4, -_TURNS_RANGE, _TURNS_RANGE),
}


def initial(begin: int) -> bytes:
    """The table from `begin` on, at delivery or power-up."""
    table = bytearray(TABLE_BYTES)
    for address, item in ITEMS.items():
        table[address : address + item.size] = item.initial.to_bytes(item.size, "little", signed=item.lowest < 0)
    return bytes(table[begin:])


def value(table: bytearray, address: int) -> int:
    """What stands at an address."""
    item = ITEMS[address]
    return int.from_bytes(table[address : address + item.size], "little", signed=item.lowest < 0)


def refusal(table: bytearray, address: int, data: bytes) -> int:
    """The number of the error with which a servo refuses to write `data`, 0 if it takes them."""
    at, end = address, address + len(data)
    if not data:
        return LENGTH_ERROR
    while at < end:
        item = ITEMS.get(at)
        if item is None or (at < STORED_END and table[TORQUE]):
            return ACCESS_ERROR
        if at + item.size > end:
            return LENGTH_ERROR
        written = int.from_bytes(data[at - address : at - address + item.size], "little", signed=item.lowest < 0)
        if error := _out_of_range(table, at, item, written):
            return error
        at += item.size
    return 0


def _out_of_range(table: bytearray, address: int, item: Item, written: int) -> int:
    lowest, highest = item.lowest, item.highest
    if address == GOAL and table[MODE] == POSITION:
        lowest, highest = value(table, MIN_POSITION), value(table, MAX_POSITION)
    if not lowest <= written <= highest or (address in GOALS and table[WATCHDOG] == WATCHDOG_EXPIRED):
        return RANGE_ERROR
    if address == GOAL_CURRENT and abs(written) > value(table, CURRENT_LIMIT):
        return LIMIT_ERROR
    return 0


COUNTS_PER_TURN = 4096
BROADCAST = 0xFE
RESULT_FAIL, INSTRUCTION_ERROR, CRC_ERROR, ALERT = 0x01, 0x02, 0x03, 0x80
OVER_HEATED, OVERLOAD, INPUT_VOLTAGE = 0x04, 0x20, 0x01
DELAY_STEP_S = 2e-6
REBOOT_S = 0.2
LATENCY_S = 0.0001
STORED = {RETURN_DELAY: 0}  # other than at delivery
FIRMWARE = 46
NUMBER, BAUD = 7, 8
KEPT_AT_RESET: dict[bytes, tuple[int, ...]] = {b"\xff": (), b"\x01": (NUMBER,), b"\x02": (NUMBER, BAUD)}
CLEAR_TURNS = b"\x01\x44\x58\x4c\x22"
NOMINAL_V = 12.0  # of the voltage limits in the table


class DynamixelInstruction(IntEnum):
    """Instructions of protocol 2.0."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


FAST: dict[int, int] = {
    DynamixelInstruction.FAST_SYNC_READ: DynamixelInstruction.SYNC_READ,
    DynamixelInstruction.FAST_BULK_READ: DynamixelInstruction.BULK_READ,
}
# From which status return level on an instruction is answered; others: 2.
LEVELS: dict[int, int] = {DynamixelInstruction.PING: 0, DynamixelInstruction.READ: 1}


def _crc_of(byte: int) -> int:
    """What a byte adds to a CRC-16 with polynomial 0x8005, bit by bit."""
    crc = byte << 8
    for _ in range(8):
        crc = (crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1
    return crc & 0xFFFF


_CRC_OF = tuple(map(_crc_of, range(256)))


def crc16(data: bytes) -> int:
    """CRC-16 with polynomial 0x8005 from 0."""
    crc = 0
    for byte in data:
        crc = (crc & 0xFF) << 8 ^ _CRC_OF[crc >> 8 ^ byte]
    return crc


@dataclass(frozen=True, slots=True)
class ServoSetup:
    """Identity and motor of a servo: `volts_per_rad_s` at the output; `current_unit_A` of the model; its nominal supply."""

    number: int
    volts_per_rad_s: float
    model: int = 1020
    current_unit_A: float = 0.00269  # 0: it has its load at that place
    mode: int = POSITION  # CURRENT_BASED keeps the goal current
    supply_V: float = NOMINAL_V


class DynamixelMock:
    """One servo. `read_turns` gives the angle of its output shaft in turns, with its zero at count 0."""

    def __init__(self, setup: ServoSetup, read_turns: Callable[[], float]) -> None:
        self.setup = setup
        self.forced_error = 0  # a persistent cause, set by a fault of the scenario
        self.turned_on = 0  # whole turns that it has counted on since its supply came on; in an extended mode
        self._read_turns: Callable[[], float] = lambda: read_turns() + self.turned_on
        self.table = bytearray(TABLE_BYTES)
        self._deliver(())
        for address, value in {**STORED, NUMBER: setup.number, MODE: setup.mode}.items():
            self.table[address] = value
        self.power_up()

    def _deliver(self, spared: tuple[int, ...]) -> None:
        """All that is stored as at delivery, but for some addresses."""
        before, self.table[:STORED_END] = bytes(self.table), initial(0)[:STORED_END]
        struct.pack_into("<H", self.table, 0, self.setup.model)
        self.table[6] = FIRMWARE
        for address in (MIN_VOLTAGE, MAX_VOLTAGE):
            limit = value(self.table, address) * self.setup.supply_V / NOMINAL_V
            struct.pack_into("<H", self.table, address, round(limit))
        for address in spared:
            self.table[address] = before[address]

    def power_up(self, now_s: float = 0.0) -> None:
        """State after power-up or a restart: what is not stored at its defaults, torque off."""
        self.table[STORED_END:] = initial(STORED_END)
        self.output = OPEN
        self._registered: tuple[int, bytes] | None = None
        self._deaf_until_s = now_s
        self._heard_s = now_s
        self._motor = ServoMotor(self.setup.volts_per_rad_s, self._read_turns, 1.0 / COUNTS_PER_TURN)
        self.write(TORQUE, bytes((self.table[STARTUP] & 1,)))

    @property
    def limit_A(self) -> float:
        """What its current loop keeps to."""
        if self.table[MODE] != CURRENT_BASED:
            return math.inf
        units = min(abs(value(self.table, at)) for at in (GOAL_CURRENT, CURRENT_LIMIT))
        return units * self.setup.current_unit_A

    @property
    def position(self) -> int:
        """Present position."""
        return round(self._read_turns() * COUNTS_PER_TURN)

    @property
    def delay_s(self) -> float:
        """From an instruction's last byte to its answer."""
        return LATENCY_S + self.table[RETURN_DELAY] * DELAY_STEP_S

    @property
    def _is_shut_down(self) -> bool:
        """Whether it has an error of those at which it is to let go; only a restart ends that."""
        return bool(self.table[ERROR_STATUS] & self.table[SHUTDOWN])

    # ---- instructions

    def answer(self, instruction: int, parameters: bytes, now_s: float) -> bytes | None:
        """Obey an instruction to this servo; the status packet, None if it gives none."""
        if now_s < self._deaf_until_s:
            return None
        self._heard_s = now_s
        number, level, alert = (self.table[NUMBER], self.table[RETURN_LEVEL], ALERT if self.table[ERROR_STATUS] else 0)
        error, data = self._obey(instruction, parameters, now_s)
        return status_packet(number, error | alert, data) if level >= LEVELS.get(instruction, 2) else None

    def read(self, address: int, count: int, now_s: float) -> tuple[int, bytes] | None:
        """Error number and bytes for one of several servos that are read at once; None if it is not there to answer."""
        if now_s < self._deaf_until_s or self.table[RETURN_LEVEL] < LEVELS[DynamixelInstruction.READ]:
            return None
        self._heard_s = now_s
        error, data = self._obey(DynamixelInstruction.READ, struct.pack("<HH", address, count), now_s)
        return error | (ALERT if self.table[ERROR_STATUS] else 0), data

    def write(self, address: int, data: bytes) -> int:
        """Write to the control table; returns an error number."""
        if error := refusal(self.table, address, data):
            return error
        if address == TORQUE and data[0] and self._is_shut_down:
            return 0  # stays off until it is restarted
        if address == TORQUE and data[0] and not self.table[TORQUE]:
            struct.pack_into("<i", self.table, GOAL, self.position)
            self._motor.engage()
        self.table[address : address + len(data)] = data
        if address <= GOAL < address + len(data) or address == TORQUE:
            self._motor.goal_turns = value(self.table, GOAL) / COUNTS_PER_TURN
        return 0

    def switch_torque(self, is_on: bool, now_s: float) -> None:
        """Another program writes the switch."""
        self.write(TORQUE, bytes((is_on,)))

    def crc_error(self, now_s: float) -> bytes | None:
        """The answer to a packet whose CRC is wrong."""
        is_there = now_s >= self._deaf_until_s and self.table[RETURN_LEVEL] == 2
        return status_packet(self.table[NUMBER], CRC_ERROR) if is_there else None

    def _obey(self, instruction: int, parameters: bytes, now_s: float) -> tuple[int, bytes]:
        address, data = int.from_bytes(parameters[:2], "little"), parameters[2:]
        match instruction:
            case DynamixelInstruction.PING:
                return 0, bytes(self.table[0:2]) + bytes(self.table[6:7])
            case DynamixelInstruction.READ:
                end = address + int.from_bytes(data, "little")
                if len(data) != 2:
                    return LENGTH_ERROR, b""
                return (0, bytes(self.table[address:end])) if end <= TABLE_BYTES else (ACCESS_ERROR, b"")
            case DynamixelInstruction.WRITE:
                return self.write(address, data), b""
            case DynamixelInstruction.REG_WRITE:
                return self._register(address, data), b""
            case DynamixelInstruction.ACTION:
                return self._act(), b""
            case DynamixelInstruction.REBOOT:
                self.power_up(now_s)
                self._deaf_until_s = now_s + REBOOT_S
                return 0, b""
            case DynamixelInstruction.RESET if parameters in KEPT_AT_RESET and not self.table[TORQUE]:
                self._deliver(KEPT_AT_RESET[parameters])
                self.power_up(now_s)
                self._deaf_until_s = now_s + REBOOT_S
                return 0, b""
            case DynamixelInstruction.CLEAR if parameters == CLEAR_TURNS and not self._motor.speed_turns_s:
                self.turned_on -= self.position // COUNTS_PER_TURN
                self._motor.turns = self._read_turns()
                return 0, b""
            case DynamixelInstruction.RESET | DynamixelInstruction.CLEAR:
                return RESULT_FAIL, b""
        return INSTRUCTION_ERROR, b""

    def _register(self, address: int, data: bytes) -> int:
        if error := refusal(self.table, address, data):
            return error
        self._registered, self.table[REGISTERED] = (address, data), 1
        return 0

    def _act(self) -> int:
        registered, self._registered, self.table[REGISTERED] = self._registered, None, 0
        return INSTRUCTION_ERROR if registered is None else self.write(*registered)

    # ---- control

    def tick(self, now_s: float, current_A: float, supply_V: float) -> None:
        """Run one control period: measure, watch the bus, and control the position."""
        motor = self._motor
        motor.measure(now_s)
        struct.pack_into(
            "<hiiiiHB",
            self.table,
            VALUES,
            self._effort(current_A, supply_V),
            round(motor.speed_turns_s * 60.0 / 0.229),
            self.position,
            0,
            0,
            round(supply_V * 10),
            35,
        )
        least, most = (value(self.table, address) for address in (MIN_VOLTAGE, MAX_VOLTAGE))
        voltage = 0 if least <= supply_V * 10 <= most else INPUT_VOLTAGE
        self.table[ERROR_STATUS] &= self.table[SHUTDOWN]  # the others last as long as their causes
        self.table[ERROR_STATUS] |= self.forced_error | voltage
        if self._is_shut_down:
            self.table[TORQUE] = 0
        watchdog = self.table[WATCHDOG]
        if self.table[TORQUE] and 0 < watchdog < 0x80 and now_s - self._heard_s > 0.02 * watchdog:
            self.table[WATCHDOG] = WATCHDOG_EXPIRED
            motor.goal_turns = motor.turns
        share = value(self.table, GOAL_PWM) / FULL_PWM
        self.output = motor.controlled(supply_V * abs(share)) if self.table[TORQUE] else OPEN

    def _effort(self, current_A: float, supply_V: float) -> int:
        """The current in the model's unit; without a sensor of it, what the output is of the supply, in 0.1 %."""
        if self.setup.current_unit_A:
            return min(max(round(current_A / self.setup.current_unit_A), -32767), 32767)
        volts = self.output.value if self.output.kind == "voltage" else 0.0
        return min(max(round(1000.0 * volts / supply_V), -1000), 1000) if supply_V > 0.0 else 0


class DynamixelLineMock:
    """A half-duplex line with servos: every servo hears all bytes; answers take their time, one after the other."""

    def __init__(self, servos: list[DynamixelMock], baud: int) -> None:
        self.servos = {servo.setup.number: servo for servo in servos}
        self.outgoing: list[tuple[float, bytes]] = []  # (arrival at the host, bytes)
        self._byte_s = 10.0 / baud
        self._received = b""

    def receive(self, received: bytes, now_s: float) -> None:
        """Bytes from the host."""
        self._received += received
        while (begin := self._received.find(b"\xff\xff\xfd\x00")) >= 0 and len(self._received) >= begin + 7:
            servo, length = struct.unpack_from("<BH", self._received, begin + 4)
            end = begin + 7 + length
            if len(self._received) < end:
                return
            packet, self._received = self._received[begin:end], self._received[end:]
            if length < 3:
                continue
            answers: Iterable[tuple[float, bytes | None]]
            if crc16(packet[:-2]) == int.from_bytes(packet[-2:], "little"):
                inside = packet[7:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
                answers = self._answers(servo, inside[0], inside[1:], now_s)
            else:
                answers = ((asked.delay_s, asked.crc_error(now_s)) for asked in self._asked(servo))
            there_s = now_s + len(packet) * self._byte_s
            for delay_s, status in answers:
                if status is None:
                    break
                there_s += delay_s + len(status) * self._byte_s
                self.outgoing.append((there_s, status))

    def _asked(self, number: int) -> list[DynamixelMock]:
        return [servo for servo in self.servos.values() if servo.table[NUMBER] == number]

    def _answers(self, number: int, instruction: int, parameters: bytes, now_s: float) -> Iterator[tuple[float, bytes | None]]:
        """The answers, each after its delay; None: somebody whose turn it was is silent."""
        if number != BROADCAST:
            for servo in self._asked(number):
                yield servo.delay_s, servo.answer(instruction, parameters, now_s)
        elif instruction in (DynamixelInstruction.SYNC_READ, DynamixelInstruction.BULK_READ):
            for which, address, count in _read_at_once(instruction, parameters):
                said = self._read(which, address, count, now_s)
                yield (0.0, None) if said is None else (said[0].delay_s, status_packet(which, *said[1:]))
        elif instruction in FAST:
            yield LATENCY_S, self._chained(FAST[instruction], parameters, now_s)
        elif instruction in (DynamixelInstruction.SYNC_WRITE, DynamixelInstruction.BULK_WRITE):
            for which, address, data in _written_at_once(instruction, parameters):
                for servo in self._asked(which):
                    servo.write(address, data)
        else:
            for _, servo in sorted(self.servos.items()):
                status = servo.answer(instruction, parameters, now_s)
                if instruction == DynamixelInstruction.PING and status is not None:
                    yield servo.delay_s, status

    def _read(self, number: int, address: int, count: int, now_s: float) -> tuple[DynamixelMock, int, bytes] | None:
        """A servo, its error number and its bytes; None if it does not answer."""
        servo = next(iter(self._asked(number)), None)
        said = servo.read(address, count, now_s) if servo else None
        return None if servo is None or said is None else (servo, *said)

    def _chained(self, instruction: int, parameters: bytes, now_s: float) -> bytes | None:
        """One packet to which every servo adds error, id, bytes, and the CRC of all that is there so far."""
        asked = list(_read_at_once(instruction, parameters))
        chain = _header(BROADCAST, 1 + sum(count + 4 for *_, count in asked)) + b"\x55"
        for which, address, count in asked:
            status = self._read(which, address, count, now_s)
            if status is None:
                break
            _, error, data = status
            chain = _with_crc(chain + bytes((error, which)) + data.ljust(count, b"\0"))
        return chain if len(chain) > 8 else None


def status_packet(number: int, error: int, parameters: bytes = b"") -> bytes:
    """A status packet; one that tells of a new id still has the old one."""
    inside = (bytes((0x55, error)) + parameters).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
    return _with_crc(_header(number, len(inside) + 2) + inside)


def _header(number: int, length: int) -> bytes:
    return b"\xff\xff\xfd\x00" + struct.pack("<BH", number, length)


def _with_crc(packet: bytes) -> bytes:
    return packet + struct.pack("<H", crc16(packet))


def _read_at_once(instruction: int, parameters: bytes) -> Iterator[tuple[int, int, int]]:
    """Id, address and count of each servo that is asked."""
    if instruction == DynamixelInstruction.BULK_READ:
        yield from struct.iter_unpack("<BHH", parameters[: len(parameters) // 5 * 5])
    elif len(parameters) > 4:
        address, count = struct.unpack_from("<HH", parameters)
        yield from ((number, address, count) for number in parameters[4:])


def _written_at_once(instruction: int, parameters: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Id, address and bytes of each servo that is written."""
    if instruction == DynamixelInstruction.SYNC_WRITE and len(parameters) > 4:
        address, size = struct.unpack_from("<HH", parameters)
        for at in range(4, len(parameters) - size, size + 1):
            yield parameters[at], address, parameters[at + 1 : at + 1 + size]
    at = 0
    while instruction == DynamixelInstruction.BULK_WRITE and len(parameters) >= at + 5:
        number, address, size = struct.unpack_from("<BHH", parameters, at)
        yield number, address, parameters[at + 5 : at + 5 + size]
        at += 5 + size
