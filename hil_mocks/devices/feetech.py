"""Feetech STS servos on a half-duplex line, written from the vendor's protocol manual and the memory table of the STS3215.

A servo is a memory table with a position loop behind it; without I/O: `receive` bytes, `tick` once per control period. It has no
watchdog: without the host it holds its last goal. A goal position that is written switches the torque on: Feetech's own examples
(FTServo_Arduino, WritePos) move servos after power-up and never write the torque switch. Of what is sent to all only PING is
answered, by all servos at once. Of several servos that are read at once each waits for the one before it: after a silent one
nobody answers.

What an error does stands in the table (Feetech, "STS Servo Memory Table Analysis"). At those of the unloading condition the
motor is let go as long as they last; but overload, a load above its threshold for its time, leaves a share of the torque until
that is switched off. A bit of the phase says whether the position counts on beyond a turn. RECOVERY, RESET and CAL are left out.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from functools import reduce

from hil_mocks.devices.motor_inputs import OPEN, Output
from hil_mocks.devices.servo_motor import ServoMotor

COUNTS_PER_TURN = 4096
BROADCAST = 0xFE
VOLTAGE, OVER_HEATED, OVERLOAD = 0x01, 0x04, 0x20
RETURN_DELAY, RETURN_LEVEL, MIN_POSITION, MAX_POSITION, HIGHEST_VOLTAGE, LOWEST_VOLTAGE = 7, 8, 9, 11, 14, 15
PHASE, UNLOADING, RESOLUTION, CORRECTION, PROTECTIVE_TORQUE, PROTECTION_TIME, OVERLOAD_TORQUE = (18, 19, 30, 31, 34, 35, 36)
STORED_END = 40  # what is below is kept without supply
STORED = {  # at delivery
    0: 3,
    1: 10,
    RETURN_LEVEL: 1,
    LOWEST_VOLTAGE: 40,
    PHASE: 0x0C,
    UNLOADING: 44,
    RESOLUTION: 1,
    PROTECTIVE_TORQUE: 20,
    PROTECTION_TIME: 200,
    OVERLOAD_TORQUE: 80,
}
FULL_ANGLE = 0x10  # bit of the phase: the position counts on beyond a turn
SPEED_0_IS_FULL = 0x08  # bit of the phase: else it stands
HIGHEST_OF_NOMINAL = 14.0 / 12.0  # as stored in servos of 12 V
TORQUE, GOAL, GOAL_SPEED, TORQUE_LIMIT, LOCK = 40, 42, 46, 48, 55
ON, DAMPED, CENTRED = 1, 2, 128  # of the torque switch
FULL_SPEED = 3400  # counts/s, at power-up
POSITION, REGISTERED, ERROR, MOVING, CURRENT, TABLE_BYTES = 56, 64, 65, 66, 69, 71
DELAY_STEP_S = 2e-6
CURRENT_UNIT_A = 0.0065
BOOT_S = 0.2
LATENCY_S = 0.0001
_EEPROM = range(5, STORED_END)  # written only while the lock is open


class FeetechInstruction(IntEnum):
    """Instructions of the protocol."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


@dataclass(frozen=True, slots=True)
class StsSetup:
    """Identity and motor of a servo: `volts_per_rad_s` at the output."""

    number: int
    volts_per_rad_s: float
    model: int = 777
    supply_V: float = 12.0  # nominal
    turns_on: bool = False  # set up for several turns: no position limits, and a position that counts on


class FeetechMock:
    """One servo. `read_turns` gives the angle of its output shaft in turns, with its zero at count 0."""

    def __init__(self, setup: StsSetup, read_turns: Callable[[], float]) -> None:
        self.setup = setup
        self.forced_error = 0  # a persistent cause, set by a fault of the scenario
        self._read_turns = read_turns
        self.table = bytearray(TABLE_BYTES)
        struct.pack_into("<H", self.table, 3, setup.model)
        self.table[5] = setup.number
        self.table[HIGHEST_VOLTAGE] = min(round(10.0 * HIGHEST_OF_NOMINAL * setup.supply_V), 254)
        for address, value in STORED.items():
            self.table[address] = value
        struct.pack_into("<H", self.table, MAX_POSITION, 0 if setup.turns_on else COUNTS_PER_TURN - 1)
        self.table[PHASE] |= FULL_ANGLE if setup.turns_on else 0
        self.power_up()
        self._deaf_until_s = 0.0

    def power_up(self, now_s: float = 0.0) -> None:
        """State after power-up or a restart: torque off, deaf while it boots."""
        self.table[STORED_END:] = bytes(TABLE_BYTES - STORED_END)
        self.table[LOCK] = 1
        struct.pack_into("<HH", self.table, GOAL_SPEED, FULL_SPEED, 1000)  # and the torque limit
        self.output = OPEN
        self._registered: tuple[int, bytes] | None = None
        self._deaf_until_s = now_s + BOOT_S
        self._motor = ServoMotor(self.setup.volts_per_rad_s, self._read_turns, 1.0 / COUNTS_PER_TURN)
        self._loaded_from_s = now_s  # since when the load has been above the overload torque
        self._is_overloaded = False

    @property
    def delay_s(self) -> float:
        """From an instruction's last byte to its answer."""
        return LATENCY_S + self.table[RETURN_DELAY] * DELAY_STEP_S

    def answer(self, instruction: int, parameters: bytes, now_s: float) -> bytes | None:
        """Obey an instruction to this servo; the status packet, None if there is none."""
        if now_s < self._deaf_until_s:
            return None
        match instruction:
            case FeetechInstruction.PING:
                return self._status()
            case FeetechInstruction.READ if len(parameters) == 2 and sum(parameters) <= TABLE_BYTES:
                return self._status(bytes(self.table[parameters[0] : sum(parameters)]))
            case FeetechInstruction.WRITE if len(parameters) > 1:
                self.write(parameters[0], parameters[1:], now_s)
            case FeetechInstruction.REG_WRITE if len(parameters) > 1:
                self._registered, self.table[REGISTERED] = (parameters[0], parameters[1:]), 1
            case FeetechInstruction.ACTION:
                registered, self._registered, self.table[REGISTERED] = self._registered, None, 0
                if registered is not None:
                    self.write(*registered, now_s)
            case _:
                return None
        return self._status() if self.table[RETURN_LEVEL] else None

    def write(self, address: int, data: bytes, now_s: float) -> None:
        """Write to the memory table; what is read-only, locked or beyond it stays."""
        end = address + len(data)
        if now_s < self._deaf_until_s or end > POSITION or address < _EEPROM.start:
            return
        if address in _EEPROM and self.table[LOCK]:
            return
        was = self.table[TORQUE]
        self.table[address:end] = data
        if self.table[TORQUE] == CENTRED:
            self.table[TORQUE] = was
            self._centre()
        if address <= GOAL < end and not address <= TORQUE < end:
            self.table[TORQUE] = ON
        if self.table[TORQUE] == ON and was != ON:
            self._motor.engage()
            if not address <= GOAL < end:
                struct.pack_into("<H", self.table, GOAL, _raw(self.position))
        if self.table[TORQUE] == ON:
            self._aim()

    def _aim(self) -> None:
        """The loop goes to the goal, within the position limits."""
        least, most = struct.unpack_from("<HH", self.table, MIN_POSITION)
        goal, _, speed = struct.unpack_from("<HHH", self.table, GOAL)
        wanted = _signed(goal)
        wanted = min(max(wanted, least), most) if most > least else wanted
        stands = not speed and not self.table[PHASE] & SPEED_0_IS_FULL
        far = 0 if stands else wanted - self.position
        self._motor.goal_turns = self._read_turns() if stands else (self._encoder + far) / COUNTS_PER_TURN

    def _centre(self) -> None:
        """Make the position 2048 here, by the correction."""
        off = (self._encoder - COUNTS_PER_TURN // 2 + 2048) % COUNTS_PER_TURN - 2048
        struct.pack_into("<H", self.table, CORRECTION, abs(off) | (1 << 11 if off < 0 else 0))

    def switch_torque(self, is_on: bool, now_s: float) -> None:
        """Another program writes the switch."""
        self.write(TORQUE, bytes((is_on,)), now_s)

    limit_A = math.inf  # it limits its duty, not its current

    @property
    def position(self) -> int:
        """Present position: within one turn, unless it is set up to count on."""
        return self._turned_on if self.table[PHASE] & FULL_ANGLE else self._turned_on % COUNTS_PER_TURN

    @property
    def _encoder(self) -> int:
        return round(self._read_turns() * COUNTS_PER_TURN)

    @property
    def _turned_on(self) -> int:
        """The encoder less the correction, whose sign is in bit 11."""
        raw = int.from_bytes(self.table[CORRECTION : CORRECTION + 2], "little")
        return self._encoder + (raw & 0x7FF if raw & 0x800 else -(raw & 0x7FF))

    def _status(self, parameters: bytes = b"") -> bytes:
        inside = bytes((self.setup.number, len(parameters) + 2, self.table[ERROR])) + parameters
        return b"\xff\xff" + inside + bytes((255 - sum(inside) % 256,))

    def tick(self, now_s: float, current_A: float, supply_V: float) -> None:
        """Run one control period. A servo that an error has let go goes on when the error is gone."""
        motor = self._motor
        motor.measure(now_s)
        speed = round(motor.speed_turns_s * COUNTS_PER_TURN)
        self.table[ERROR] = self._errors(now_s, supply_V)
        struct.pack_into(
            "<HHHBB", self.table, POSITION, _raw(self.position), _raw(speed), self._load(supply_V), round(supply_V * 10), 35
        )
        self.table[MOVING] = int(speed != 0)
        struct.pack_into("<H", self.table, CURRENT, _raw(round(current_A / CURRENT_UNIT_A)))
        protected = self.table[ERROR] & self.table[UNLOADING]
        is_driven = self.table[TORQUE] == ON and not protected & ~OVERLOAD and now_s >= self._deaf_until_s
        (permille,) = struct.unpack_from("<H", self.table, TORQUE_LIMIT)
        if protected & OVERLOAD:
            permille = min(permille, 10 * self.table[PROTECTIVE_TORQUE])
        self.output = motor.controlled(supply_V * min(permille, 1000) / 1000) if is_driven else OPEN
        if self.table[TORQUE] == DAMPED and not protected:
            self.output = Output("voltage", 0.0)

    def _load(self, supply_V: float) -> int:
        """The duty of its output, in thousandths; its sign in bit 10."""
        if self.output.kind != "voltage" or supply_V <= 0.0:
            return 0
        permille = round(1000.0 * self.output.value / supply_V)
        return min(abs(permille), 1000) | (0x400 if permille < 0 else 0)

    def _errors(self, now_s: float, supply_V: float) -> int:
        """The status byte."""
        lowest, highest = self.table[LOWEST_VOLTAGE], self.table[HIGHEST_VOLTAGE]
        voltage = 0 if lowest <= supply_V * 10 <= highest else VOLTAGE
        is_loaded = self._load(supply_V) & 0x3FF > 10 * self.table[OVERLOAD_TORQUE]
        if not self.table[TORQUE]:
            self._is_overloaded = is_loaded = False
        if not is_loaded:
            self._loaded_from_s = now_s
        elif now_s - self._loaded_from_s > 0.01 * self.table[PROTECTION_TIME]:
            self._is_overloaded = True
        return self.forced_error | voltage | (OVERLOAD if self._is_overloaded else 0)


class FeetechLineMock:
    """A half-duplex line with servos: every servo hears all bytes; answers take their time."""

    def __init__(self, servos: list[FeetechMock], baud: int) -> None:
        self.servos = {servo.setup.number: servo for servo in servos}
        self.outgoing: list[tuple[float, bytes]] = []  # (arrival at the host, bytes)
        self._byte_s = 10.0 / baud
        self._received = b""

    def receive(self, received: bytes, now_s: float) -> None:
        """Bytes from the host."""
        self._received += received
        while (begin := self._received.find(b"\xff\xff")) >= 0 and len(self._received) >= begin + 4:
            end = begin + 4 + self._received[begin + 3]
            if len(self._received) < end:
                return
            packet, self._received = self._received[begin:end], self._received[end:]
            if len(packet) >= 6 and sum(packet[2:]) % 256 == 255:
                self._obey(packet[2], packet[4], packet[5:-1], len(packet), now_s)

    def _obey(self, number: int, instruction: int, parameters: bytes, sent_bytes: int, now_s: float) -> None:
        there_s = now_s + sent_bytes * self._byte_s
        for delay_s, status in self._answers(number, instruction, parameters, now_s):
            there_s += delay_s + len(status) * self._byte_s
            self.outgoing.append((there_s, status))

    def _answers(self, number: int, instruction: int, parameters: bytes, now_s: float) -> Iterator[tuple[float, bytes]]:
        """The answers, each after its delay."""
        if instruction == FeetechInstruction.SYNC_READ and number == BROADCAST:
            for which in parameters[2:]:
                servo = self.servos.get(which)
                status = servo.answer(FeetechInstruction.READ, parameters[:2], now_s) if servo else None
                if servo is None or status is None:
                    return
                yield servo.delay_s, status
        elif instruction == FeetechInstruction.SYNC_WRITE and len(parameters) > 2:
            address, size = parameters[:2]
            for at in range(2, len(parameters) - size, size + 1):
                if (servo := self.servos.get(parameters[at])) is not None:
                    servo.write(address, parameters[at + 1 : at + 1 + size], now_s)
        elif number == BROADCAST:
            answers = [servo.answer(instruction, parameters, now_s) for servo in self.servos.values()]
            if instruction == FeetechInstruction.PING and (said := [one for one in answers if one is not None]):
                yield LATENCY_S, reduce(_collided, said)
        elif (asked := self.servos.get(number)) and (status := asked.answer(instruction, parameters, now_s)):
            yield asked.delay_s, status


def _collided(first: bytes, second: bytes) -> bytes:
    """What is heard of two that speak at once: a 0 wins."""
    return bytes(a & b for a, b in zip(first, second, strict=True))


def _signed(raw: int) -> int:
    return -(raw & 0x7FFF) if raw & 0x8000 else raw


def _raw(value: int) -> int:
    return abs(value) & 0x7FFF | (0x8000 if value < 0 else 0)
