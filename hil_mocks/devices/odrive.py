"""An ODrive axis on CAN, written from ODrive's documentation of CANSimple and its DBC (firmware 0.6).

With `is_firmware_5` it answers what firmware 0.5.6 answers to an empty frame (its can_simple.cpp), and has the same messages.
A state machine without I/O: `receive` frames with 11-bit ids, `tick` once per control period, read `output`. What is assumed of
its settings (odrivetool) is in `OdriveSetup`. Requests by remote frames are left out: its messages come at their rates.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from hil_mocks.devices.motor_inputs import OPEN, Frame, Output
from hil_mocks.devices.servo_motor import ServoMotor

HEARTBEAT, ESTOP, GET_ERROR, SENSORLESS_ERROR, STATE, ENCODER, MODE = 0x01, 0x02, 0x03, 0x05, 0x07, 0x09, 0x0B
POSITION, TORQUE, LIMITS, IQ, TEMPERATURE, REBOOT, BUS, CLEAR = 0x0C, 0x0E, 0x0F, 0x14, 0x15, 0x16, 0x17, 0x18
IDLE, CLOSED_LOOP = 1, 8
TORQUE_CONTROL, POSITION_CONTROL = 1, 3
SUPPLY_LOW, OVER_CURRENT, OVER_HEATED, TOO_FAST = 0x200, 0x1000, 0x4000, 0x8000
WATCHDOG, STOPPED = 0x100_0000, 0x200_0000
SUCCESS, DISARMED, NOT_CALIBRATED = 0, 3, 14
BROADCAST = 63
ARM_S = 0.002  # until a state that was asked for is entered
BOOT_S = 0.15
LOWEST_SUPPLY_V = 10.5
SPEED_TOLERANCE = 1.2
LIMITED_SHARE = 0.98  # of the current limit: more is at the limit


@dataclass(frozen=True, slots=True)
class OdriveSetup:
    """Motor and settings. `periods_s`: of the messages."""

    node: int
    torque_constant_Nm_A: float
    limit_A: float
    is_calibrated: bool = True
    watchdog_s: float = 0.1
    is_firmware_5: bool = False
    periods_s: tuple[tuple[int, float], ...] = (
        (HEARTBEAT, 0.01), (ENCODER, 0.004), (IQ, 0.004), (BUS, 0.01), (TEMPERATURE, 0.1), (GET_ERROR, 0.1)
    )  # fmt: skip


class OdriveMock:
    """One axis. `read_turns` gives the angle of its encoder in turns."""

    def __init__(self, setup: OdriveSetup, read_turns: Callable[[], float]) -> None:
        self.setup = setup
        self.outgoing: list[Frame] = []
        self.is_home = False  # no message tells of it
        self.forced_error = 0  # a persistent cause, set by a fault of the scenario
        self._read_turns = read_turns
        self.power_up(None)

    def power_up(self, now_s: float | None) -> None:
        """State after power-up or a restart; it is deaf and silent while it boots."""
        start_s = 0.0 if now_s is None else now_s
        self.state, self.errors, self.result = IDLE, 0, SUCCESS
        self.output = OPEN
        self.control = POSITION_CONTROL  # as stored
        self.limit_A, self._limit_turns_s = self.setup.limit_A, math.inf
        self._torque_Nm = self._current_A = 0.0
        self._motor = ServoMotor(self.setup.torque_constant_Nm_A, self._read_turns)
        self._arms_at_s = math.inf
        self._heard_s = start_s
        self._boots_until_s = -math.inf if now_s is None else now_s + BOOT_S
        self._next_s = dict.fromkeys((command for command, _ in self.setup.periods_s), start_s)

    # ---- frames

    def receive(self, can_id: int, payload: bytes, now_s: float) -> None:
        """Process a frame with an 11-bit id."""
        if can_id >> 5 not in (self.setup.node, BROADCAST) or now_s < self._boots_until_s:
            return
        command = can_id & 0x1F
        if command == STATE and len(payload) >= 4:
            self._ask(struct.unpack("<I", payload[:4])[0], now_s)
        elif command == SENSORLESS_ERROR and not payload and self.setup.is_firmware_5:
            self.outgoing.append((self.setup.node << 5 | command, bytes(8)))
        elif command == MODE and len(payload) == 8:
            self.control = struct.unpack("<II", payload)[0]
        elif command == POSITION and len(payload) == 8:
            self._motor.goal_turns, speed, torque_mNm = struct.unpack("<fhh", payload)
            self._motor.goal_turns_s, self._torque_Nm, self._heard_s = 1e-3 * speed, 1e-3 * torque_mNm, now_s
        elif command == TORQUE and len(payload) >= 4:
            (self._torque_Nm,) = struct.unpack("<f", payload[:4])
            self._heard_s = now_s
        elif command == LIMITS and len(payload) == 8:
            self._limit_turns_s, self.limit_A = struct.unpack("<ff", payload)
        elif command == ESTOP:
            self._disarm(STOPPED)
        elif command == CLEAR:
            self.errors, self._heard_s = 0, now_s
        elif command == REBOOT:
            self.power_up(now_s)

    def switch_torque(self, is_on: bool, now_s: float) -> None:
        """Another program asks for closed-loop control, or for idle."""
        self._ask(CLOSED_LOOP if is_on else IDLE, now_s)

    def _ask(self, state: int, now_s: float) -> None:
        """Leave the state, the one that is asked for too; closed-loop control is entered a little later."""
        self.state, self.result = IDLE, SUCCESS
        self._arms_at_s = math.inf
        if state != CLOSED_LOOP:
            return
        if self.setup.is_calibrated and not self._cause:
            self._arms_at_s = now_s + ARM_S
        else:
            self.result = DISARMED if self._cause else NOT_CALIBRATED

    @property
    def _cause(self) -> int:
        return self.forced_error

    def _disarm(self, error: int) -> None:
        self.errors |= error
        self._arms_at_s = math.inf
        if self.state == CLOSED_LOOP:
            self.state, self.result = IDLE, DISARMED

    def _send_status(self, now_s: float, current_A: float, supply_V: float) -> None:
        motor = self._motor
        for command, period_s in self.setup.periods_s:
            if now_s < self._next_s[command]:
                continue
            self._next_s[command] += period_s
            payload = {
                HEARTBEAT: lambda: struct.pack("<IBBH", self.errors, self.state, self.result, 1),
                GET_ERROR: lambda: struct.pack("<II", self._cause, self.errors),
                ENCODER: lambda: struct.pack("<ff", motor.turns, motor.speed_turns_s),
                IQ: lambda: struct.pack("<ff", self._torque_Nm / self.setup.torque_constant_Nm_A, current_A),
                TEMPERATURE: lambda: struct.pack("<ff", 35.0, math.nan),  # no thermistor in the motor
                BUS: lambda: struct.pack("<ff", supply_V, 0.0),
            }[command]()
            self.outgoing.append((self.setup.node << 5 | command, payload))

    # ---- control

    def tick(self, now_s: float, current_A: float, supply_V: float) -> None:
        """Run one control period."""
        self._motor.measure(now_s)
        self._current_A = current_A
        if now_s < self._boots_until_s:
            self._next_s = dict.fromkeys(self._next_s, now_s)
            self._heard_s = now_s
            return
        if now_s >= self._arms_at_s:
            self._enter()
        if now_s - self._heard_s > self.setup.watchdog_s:
            self._disarm(WATCHDOG)
        if cause := self._cause or (SUPPLY_LOW if supply_V < LOWEST_SUPPLY_V else 0):
            self._disarm(cause)
        if (
            self.state == CLOSED_LOOP
            and abs(self._motor.speed_turns_s) > SPEED_TOLERANCE * self._limit_turns_s
        ):
            self._disarm(TOO_FAST)
        self.output = self._driven(supply_V) if self.state == CLOSED_LOOP else OPEN
        self._send_status(now_s, current_A, supply_V)

    def _enter(self) -> None:
        """Closed-loop control begins where the motor is."""
        self.state, self._arms_at_s = CLOSED_LOOP, math.inf
        self._motor.goal_turns, self._motor.goal_turns_s = self._motor.turns, 0.0
        self._motor.engage()

    def _driven(self, supply_V: float) -> Output:
        if self.control == POSITION_CONTROL:
            return self._motor.controlled(supply_V, abs(self._current_A) > LIMITED_SHARE * self.limit_A)
        wanted_A = self._torque_Nm / self.setup.torque_constant_Nm_A
        limited_A = min(max(wanted_A, -self.limit_A), self.limit_A)
        return Output("current", limited_A) if limited_A else OPEN
