"""Dynamixel X servos on a half-duplex line, written from the ROBOTIS e-Manual (protocol 2.0, control table of XL330 and XM430).

A servo is a control table with a position loop behind it; without I/O: `receive` bytes, `tick` once per control period.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from hil_mocks.devices.motor_inputs import OPEN
from hil_mocks.devices.servo_motor import ServoMotor

COUNTS_PER_TURN = 4096
PING, READ, WRITE, REBOOT, SYNC_WRITE, BROADCAST = 0x01, 0x02, 0x03, 0x08, 0x83, 0xFE
INSTRUCTION_ERROR, CRC_ERROR, LENGTH_ERROR, ACCESS_ERROR, ALERT = 0x02, 0x03, 0x05, 0x07, 0x80
OVER_HEATED, OVERLOAD, LOW_VOLTAGE = 0x04, 0x20, 0x01
TORQUE, ERROR_STATUS, WATCHDOG, GOALS, GOAL, VALUES, TABLE_BYTES = 64, 70, 98, (100, 120), 116, 126, 147
POSITION, CURRENT_BASED = 3, 5  # operating modes
GOAL_CURRENT, CURRENT_LIMIT = 102, 1193
REBOOT_S = 0.2
LATENCY_S = 0.0001
_EEPROM_END = 64  # below, only while the torque is off


def crc16(data: bytes) -> int:
    """CRC-16 with polynomial 0x8005 from 0, bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1
    return crc & 0xFFFF


@dataclass(frozen=True, slots=True)
class ServoSetup:
    """Identity and motor of a servo: `volts_per_rad_s` at the output; `current_unit_A` of the model."""

    number: int
    volts_per_rad_s: float
    model: int = 1020
    current_unit_A: float = 0.00269
    return_delay_s: float = 0.0
    mode: int = POSITION  # CURRENT_BASED keeps the goal current


class DynamixelMock:
    """One servo. `read_turns` gives the angle of its output shaft in turns, with its zero at count 0."""

    def __init__(self, setup: ServoSetup, read_turns: Callable[[], float]) -> None:
        self.setup = setup
        self.forced_error = 0  # a persistent cause, set by a fault of the scenario
        self._read_turns = read_turns
        self.power_up()

    def power_up(self, now_s: float = 0.0) -> None:
        """State after power-up or a restart: the RAM area at its defaults, torque off."""
        self.table = bytearray(TABLE_BYTES)
        struct.pack_into("<H", self.table, 0, self.setup.model)
        self.table[6], self.table[7], self.table[11] = 46, self.setup.number, self.setup.mode
        struct.pack_into("<H", self.table, GOAL_CURRENT, CURRENT_LIMIT)
        self.output = OPEN
        self._deaf_until_s = now_s
        self._heard_s = now_s
        self._motor = ServoMotor(self.setup.volts_per_rad_s, self._read_turns)

    @property
    def limit_A(self) -> float:
        """What its current loop keeps to."""
        if self.setup.mode != CURRENT_BASED:
            return math.inf
        (units,) = struct.unpack_from("<H", self.table, GOAL_CURRENT)
        return float(min(units, CURRENT_LIMIT) * self.setup.current_unit_A)

    @property
    def position(self) -> int:
        """Present position."""
        return round(self._read_turns() * COUNTS_PER_TURN)

    # ---- instructions

    def answer(self, instruction: int, parameters: bytes, now_s: float) -> bytes | None:
        """Obey an instruction to this servo; the status packet, None while it restarts."""
        if now_s < self._deaf_until_s:
            return None
        self._heard_s = now_s
        if instruction == PING:
            return self._status(0, bytes(self.table[0:2]) + bytes(self.table[6:7]))
        if instruction == READ and len(parameters) == 4:
            address, count = struct.unpack("<HH", parameters)
            if address + count > TABLE_BYTES:
                return self._status(ACCESS_ERROR)
            return self._status(0, bytes(self.table[address : address + count]))
        if instruction == WRITE and len(parameters) > 2:
            return self._status(self.write(int.from_bytes(parameters[:2], "little"), parameters[2:]))
        if instruction == REBOOT:
            status = self._status(0)
            self.power_up(now_s)
            self._deaf_until_s = now_s + REBOOT_S
            return status
        return self._status(INSTRUCTION_ERROR)

    def write(self, address: int, data: bytes) -> int:
        """Write to the control table; returns an error number."""
        if address < _EEPROM_END and self.table[TORQUE]:
            return ACCESS_ERROR
        if address >= VALUES or address + len(data) > VALUES:
            return ACCESS_ERROR
        if GOALS[0] <= address < GOALS[1] and self.table[WATCHDOG] == 0xFF:
            return ACCESS_ERROR
        if address == TORQUE and data[0] and self.table[ERROR_STATUS]:
            return 0  # stays off until it is restarted
        if address == TORQUE and data[0] and not self.table[TORQUE]:
            struct.pack_into("<i", self.table, GOAL, self.position)
            self._motor.engage()
        self.table[address : address + len(data)] = data
        if address <= GOAL < address + len(data) or address == TORQUE:
            (goal,) = struct.unpack_from("<i", self.table, GOAL)
            self._motor.goal_turns = goal / COUNTS_PER_TURN
        return 0

    def _status(self, error: int, parameters: bytes = b"") -> bytes:
        if self.table[ERROR_STATUS]:
            error |= ALERT
        inside = bytes((0x55, error)) + parameters
        inside = inside.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        body = b"\xff\xff\xfd\x00" + struct.pack("<BH", self.setup.number, len(inside) + 2) + inside
        return body + struct.pack("<H", crc16(body))

    # ---- control

    def tick(self, now_s: float, current_A: float, supply_V: float) -> None:
        """Run one control period: measure, watch the bus, and control the position."""
        motor = self._motor
        motor.measure(now_s)
        struct.pack_into(
            "<hiiiiHB", self.table, VALUES, min(max(round(current_A / self.setup.current_unit_A), -32767), 32767),
            round(motor.speed_turns_s * 60.0 / 0.229), self.position, 0, 0, round(supply_V * 10), 35,
        )  # fmt: skip
        if self.forced_error:
            self.table[ERROR_STATUS] |= self.forced_error
        if self.table[ERROR_STATUS]:
            self.table[TORQUE] = 0
        watchdog = self.table[WATCHDOG]
        if self.table[TORQUE] and 0 < watchdog < 0x80 and now_s - self._heard_s > 0.02 * watchdog:
            self.table[WATCHDOG] = 0xFF
            motor.goal_turns = motor.turns
        self.output = motor.controlled(supply_V) if self.table[TORQUE] else OPEN


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
            if length >= 3 and crc16(packet[:-2]) == int.from_bytes(packet[-2:], "little"):
                inside = packet[7:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
                self._obey(servo, inside[0], inside[1:], len(packet), now_s)

    def _obey(self, number: int, instruction: int, parameters: bytes, sent_bytes: int, now_s: float) -> None:
        if instruction == SYNC_WRITE:
            address, size = struct.unpack_from("<HH", parameters)
            for at in range(4, len(parameters) - size, size + 1):
                if (servo := self.servos.get(parameters[at])) is not None:
                    servo.write(address, parameters[at + 1 : at + 1 + size])
            return
        asked = list(self.servos.values()) if number == BROADCAST else [self.servos.get(number)]
        there_s = now_s + sent_bytes * self._byte_s
        for servo in asked:
            if servo is not None and (status := servo.answer(instruction, parameters, now_s)) is not None:
                there_s += LATENCY_S + servo.setup.return_delay_s + len(status) * self._byte_s
                self.outgoing.append((there_s, status))
