"""A VESC with a brushed motor on CAN, written from the firmware's documentation (comm_can, datatypes: packets, faults, time-out).

A state machine without I/O: `receive` frames with 29-bit ids, `tick` once per control period, read `output`. What is assumed of
its settings (VESC Tool) is in `VescSetup`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from hil_mocks.devices.motor_inputs import BRAKE, OPEN, Output

SET_DUTY, SET_CURRENT, SET_BRAKE, SET_POS, SHORT_BUFFER, PING, LIMITS = 0, 1, 2, 4, 8, 17, 21
FILL, FILL_LONG, PROCESS = 5, 6, 7
STATUS, STATUS_2, STATUS_3, STATUS_4, PONG, STATUS_5, BOOT, STATUS_6 = 9, 14, 15, 16, 18, 27, 57, 58
EVERYONE = 255
OVER_CURRENT, OVER_HEATED, UNDER_VOLTAGE = 4, 5, 2
TURN = 18_000  # counts of the angle in STATUS_4
MOST_DUTY = 0.95
FAULT_S = 0.5  # a fault stops the motor for so long, then commands are obeyed again
BOOT_S = 0.15
LOWEST_SUPPLY_V = 8.0
POSITION_RATE, SPEED_GAIN, SPEED_FILTER_S = 15.0, 0.5, 0.003


@dataclass(frozen=True, slots=True)
class VescSetup:
    """Motor and settings. Status messages 1, 4, 5 and 6 at rate 1, 2 and 3 at rate 2."""

    number: int
    volts_per_turn_s: float
    """Of the shaft with the encoder."""
    limit_A: float
    resistance_ohm: float = 0.5
    rate_1_Hz: float = 200.0
    rate_2_Hz: float = 5.0
    timeout_s: float = 0.1
    timeout_brake_A: float = 20.0
    application: int = 0
    answers: bool = True  # questions; else it only sends its status and obeys, as emulators do


class VescMock:
    """One controller. `read_turns` gives the angle of its encoder in turns."""

    def __init__(self, setup: VescSetup, read_turns: Callable[[], float]) -> None:
        self.setup = setup
        self.outgoing: list[tuple[int, bytes]] = []
        self.forced_error = 0  # a persistent cause, set by a fault of the scenario
        self.is_home = False
        self._read_turns = read_turns
        self.power_up(None)

    def power_up(self, now_s: float | None) -> None:
        """State after power-up or a restart; it is deaf while it boots."""
        self.fault = 0
        self.output = OPEN
        self.limit_A = self.setup.limit_A
        self._command: tuple[str, float] = ("current", 0.0)
        self._heard_s = self._next_s = self._next_2_s = 0.0 if now_s is None else now_s
        self._boots_until_s = -math.inf if now_s is None else now_s + BOOT_S
        self._is_announced = now_s is None
        self._fault_until_s = -math.inf
        self._ticked_s: float | None = None
        self._before, self._speed = self._read_turns(), 0.0
        self._drawn_As = 0.0

    # ---- frames

    def receive(self, can_id: int, payload: bytes, now_s: float) -> None:
        """Process a frame with a 29-bit id."""
        if can_id & 0xFF not in (self.setup.number, EVERYONE) or now_s < self._boots_until_s:
            return
        packet = can_id >> 8
        scales = {SET_DUTY: 1e5, SET_CURRENT: 1e3, SET_BRAKE: 1e3, SET_POS: 1e6}
        if packet in scales and len(payload) >= 4:
            names = {SET_DUTY: "duty", SET_CURRENT: "current", SET_BRAKE: "brake", SET_POS: "position"}
            self._command = (names[packet], struct.unpack(">i", payload[:4])[0] / scales[packet])
            self._heard_s = now_s
        elif not self.setup.answers and packet in (PING, SHORT_BUFFER):
            return
        elif packet == PING and payload:
            self._send(PONG, bytes((self.setup.number, 0)), payload[0])
        elif packet == LIMITS and len(payload) == 8:
            self.limit_A = struct.unpack(">ii", payload)[1] / 1e3
        elif packet == SHORT_BUFFER and len(payload) >= 3 and payload[1] == 0:
            self._answer(payload[0], payload[2:])

    def switch_torque(self, is_on: bool, now_s: float) -> None:
        """Another program gives it a duty, or shorts the windings; it obeys until its time-out."""
        self._command, self._heard_s = ("duty", 0.1 if is_on else 0.0), now_s

    def _answer(self, asker: int, command: bytes) -> None:
        """COMM_GET_VALUES_SELECTIVE for the fault code, and COMM_GET_APPCONF; other commands are left out here."""
        if command[0] == 17:
            self._send_buffer(asker, bytes((17,)) + self._appconf())
        elif command[0] == 50 and command[1:] == struct.pack(">I", 1 << 15):
            self._send(SHORT_BUFFER, bytes((self.setup.number, 1)) + command + bytes((self.fault,)), asker)

    def _appconf(self) -> bytes:
        """Up to the application as firmware 6.0 packs it; what follows is left at 0."""
        setup = self.setup
        rates = struct.pack(">HHBBB", round(setup.rate_1_Hz), round(setup.rate_2_Hz), 0x3F, 0, 3)
        head = struct.pack(">IBIf", 486554156, setup.number, round(1e3 * setup.timeout_s), setup.timeout_brake_A)
        return (head + rates + bytes(13) + bytes((setup.application,))).ljust(490, b"\0")

    def _send_buffer(self, asker: int, data: bytes) -> None:
        """More than fits a frame: pieces of 7 bytes up to place 255, then of 6, then length and CRC."""
        at = 0
        while at < len(data):
            size, place = (7, struct.pack(">B", at)) if at < 256 else (6, struct.pack(">H", at))
            self._send(FILL if at < 256 else FILL_LONG, place + data[at : at + size], asker)
            at += size
        self._send(PROCESS, struct.pack(">BBHH", self.setup.number, 1, len(data), _crc16(data)), asker)

    def _send(self, packet: int, payload: bytes, to: int | None = None) -> None:
        self.outgoing.append((packet << 8 | (self.setup.number if to is None else to), payload))

    def _send_status(self, now_s: float, current_A: float, supply_V: float) -> None:
        kind, value = self.output
        volts = value if kind == "voltage" else 0.0
        if kind == "current":  # by the duty that its current loop needs
            volts = self.setup.resistance_ohm * value + self.setup.volts_per_turn_s * self._speed
        duty = volts / supply_V if supply_V else 0.0
        if now_s >= self._next_s:
            self._next_s += 1.0 / self.setup.rate_1_Hz
            sensed = current_A * math.copysign(1.0, duty)
            self._send(STATUS, struct.pack(">ihh", round(60 * self._speed), round(sensed * 10), round(duty * 1000)))
            angle = round(self._read_turns() * TURN) % TURN
            self._send(STATUS_4, struct.pack(">hhhh", 350, 300, round(abs(duty * current_A) * 10), angle))
            self._send(STATUS_5, struct.pack(">ihh", 0, round(supply_V * 10), 0))
            self._send(STATUS_6, struct.pack(">hhhh", 3300 if self.is_home else 0, 0, 0, 0))
        if now_s >= self._next_2_s:
            self._next_2_s += 1.0 / self.setup.rate_2_Hz
            self._send(STATUS_2, struct.pack(">ii", round(self._drawn_As / 3600 * 1e4), 0))
            self._send(STATUS_3, struct.pack(">ii", round(self._drawn_As * supply_V / 3600 * 1e4), 0))

    # ---- control

    def tick(self, now_s: float, current_A: float, supply_V: float) -> None:
        """Run one control period."""
        step_s = 0.001 if self._ticked_s is None else now_s - self._ticked_s
        self._ticked_s = now_s
        self._drawn_As += abs(current_A) * step_s
        turns = self._read_turns()
        rate, self._before = (turns - self._before) / step_s, turns
        self._speed += (rate - self._speed) * step_s / (step_s + SPEED_FILTER_S)
        if now_s < self._boots_until_s:
            return
        if not self._is_announced:
            self._is_announced = True
            self._send(BOOT, b"\x00\x00")
        if cause := self.forced_error or (UNDER_VOLTAGE if supply_V < LOWEST_SUPPLY_V else 0):
            self.fault, self._fault_until_s = cause, now_s + FAULT_S
        elif now_s >= self._fault_until_s:
            self.fault = 0
        if now_s - self._heard_s > self.setup.timeout_s:
            self._command = ("brake", self.setup.timeout_brake_A)
        self.output = OPEN if self.fault else self._driven(supply_V)
        self._send_status(now_s, current_A, supply_V)

    def _driven(self, supply_V: float) -> Output:
        kind, value = self._command
        if kind == "duty":
            share = min(max(value, -MOST_DUTY), MOST_DUTY)
            return Output("voltage", share * supply_V) if share else BRAKE
        if kind == "current":
            limited = min(max(value, -self.limit_A), self.limit_A)
            return Output("current", limited) if limited else OPEN
        if kind == "brake":
            return BRAKE if value else OPEN
        return self._to_angle(value / 360.0, supply_V)

    def _to_angle(self, turns: float, supply_V: float) -> Output:
        """Turn the shorter way to an angle within one turn."""
        error = (turns - self._before + 0.5) % 1.0 - 0.5
        wanted = POSITION_RATE * error
        volts = self.setup.volts_per_turn_s * (wanted + SPEED_GAIN * (wanted - self._speed))
        return Output("voltage", min(max(volts, -supply_V), supply_V))


def _crc16(data: bytes) -> int:
    """CRC-16 with polynomial 0x1021 from 0, bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1
    return crc & 0xFFFF
