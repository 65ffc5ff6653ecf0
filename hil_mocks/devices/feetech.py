"""Feetech STS servos on a half-duplex line, written from the vendor's protocol manual and the memory table of the STS3215.

A servo is a memory table with a position loop behind it; without I/O: `receive` bytes, `tick` once per control period. It has no
watchdog: without the host it holds its last goal.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from hil_mocks.devices.motor_inputs import OPEN
from hil_mocks.devices.servo_motor import ServoMotor

COUNTS_PER_TURN = 4096
PING, READ, WRITE, SYNC_WRITE, BROADCAST = 0x01, 0x02, 0x03, 0x83, 0xFE
OVER_HEATED, OVERLOAD = 0x04, 0x20
TORQUE, GOAL, TORQUE_LIMIT, LOCK, POSITION, ERROR, CURRENT, TABLE_BYTES = 40, 42, 48, 55, 56, 65, 69, 71
CURRENT_UNIT_A = 0.0065
BOOT_S = 0.2
LATENCY_S = 0.0001
_EEPROM = range(5, 40)  # written only while the lock is open


@dataclass(frozen=True, slots=True)
class StsSetup:
    """Identity and motor of a servo: `volts_per_rad_s` at the output."""

    number: int
    volts_per_rad_s: float
    model: int = 777


class FeetechMock:
    """One servo. `read_turns` gives the angle of its output shaft in turns, with its zero at count 0."""

    def __init__(self, setup: StsSetup, read_turns: Callable[[], float]) -> None:
        self.setup = setup
        self.forced_error = 0  # a persistent cause, set by a fault of the scenario
        self._read_turns = read_turns
        self.power_up()
        self._deaf_until_s = 0.0

    def power_up(self, now_s: float = 0.0) -> None:
        """State after power-up or a restart: torque off, deaf while it boots."""
        self.table = bytearray(TABLE_BYTES)
        struct.pack_into("<H", self.table, 3, self.setup.model)
        self.table[5], self.table[LOCK] = self.setup.number, 1
        struct.pack_into("<H", self.table, TORQUE_LIMIT, 1000)
        self.output = OPEN
        self._deaf_until_s = now_s + BOOT_S
        self._motor = ServoMotor(self.setup.volts_per_rad_s, self._read_turns)

    def answer(self, instruction: int, parameters: bytes, now_s: float) -> bytes | None:
        """Obey an instruction to this servo; the status packet, None if there is none."""
        if now_s < self._deaf_until_s:
            return None
        if instruction == PING:
            return self._status()
        if instruction == READ and len(parameters) == 2 and sum(parameters) <= TABLE_BYTES:
            address, count = parameters
            return self._status(bytes(self.table[address : address + count]))
        if instruction == WRITE and len(parameters) > 1:
            self.write(parameters[0], parameters[1:], now_s)
            return self._status()
        return None

    def write(self, address: int, data: bytes, now_s: float) -> None:
        """Write to the memory table; what is read-only, locked or beyond it stays."""
        end = address + len(data)
        if now_s < self._deaf_until_s or end > POSITION or address < _EEPROM.start:
            return
        if address in _EEPROM and self.table[LOCK]:
            return
        was_on = self.table[TORQUE]
        self.table[address:end] = data
        if self.table[TORQUE] and not was_on:
            self._motor.engage()
            if not address <= GOAL < end:
                struct.pack_into("<H", self.table, GOAL, _raw(self.position))
        if self.table[TORQUE]:
            self._motor.goal_turns = _signed(struct.unpack_from("<H", self.table, GOAL)[0]) / COUNTS_PER_TURN

    limit_A = math.inf  # it limits its duty, not its current

    @property
    def position(self) -> int:
        """Present position."""
        return round(self._read_turns() * COUNTS_PER_TURN)

    def _status(self, parameters: bytes = b"") -> bytes:
        inside = bytes((self.setup.number, len(parameters) + 2, self.table[ERROR])) + parameters
        return b"\xff\xff" + inside + bytes((255 - sum(inside) % 256,))

    def tick(self, now_s: float, current_A: float, supply_V: float) -> None:
        """Run one control period. A servo with an error lets its motor go, and goes on when the error is gone."""
        motor = self._motor
        motor.measure(now_s)
        speed = round(motor.speed_turns_s * COUNTS_PER_TURN)
        self.table[ERROR] = self.forced_error
        struct.pack_into(
            "<HHHBB", self.table, POSITION, _raw(self.position), _raw(speed), 0, round(supply_V * 10), 35
        )
        struct.pack_into("<H", self.table, CURRENT, _raw(round(current_A / CURRENT_UNIT_A)))
        is_driven = self.table[TORQUE] and not self.table[ERROR] and now_s >= self._deaf_until_s
        (permille,) = struct.unpack_from("<H", self.table, TORQUE_LIMIT)
        self.output = motor.controlled(supply_V * min(permille, 1000) / 1000) if is_driven else OPEN


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
        if instruction == SYNC_WRITE and len(parameters) > 2:
            address, size = parameters[:2]
            for at in range(2, len(parameters) - size, size + 1):
                if (servo := self.servos.get(parameters[at])) is not None:
                    servo.write(address, parameters[at + 1 : at + 1 + size], now_s)
            return
        asked = self.servos.get(number)
        if asked is not None and (status := asked.answer(instruction, parameters, now_s)) is not None:
            there_s = now_s + (sent_bytes + len(status)) * self._byte_s + LATENCY_S
            self.outgoing.append((there_s, status))


def _signed(raw: int) -> int:
    return -(raw & 0x7FFF) if raw & 0x8000 else raw


def _raw(value: int) -> int:
    return abs(value) & 0x7FFF | (0x8000 if value < 0 else 0)
