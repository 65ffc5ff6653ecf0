"""An ODrive axis on CAN, written from ODrive's documentation of CANSimple and its DBC (firmware 0.6.10).

With `is_firmware_5` it answers what firmware 0.5.6 answers to an empty frame (its can_simple.cpp), and has the same messages.
A state machine without I/O: `receive` frames with 11-bit ids, `tick` once per control period, read `output`. What is assumed of
its settings (odrivetool) is in `OdriveSetup`. Input modes are passthrough and trapezoidal trajectory; another is as passthrough.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from hil_mocks.devices.motor_inputs import OPEN, Frame, Output
from hil_mocks.devices.servo_motor import TUNED_SPEED_GAIN, ServoMotor

VERSION, HEARTBEAT, ESTOP, GET_ERROR, WRITE_SDO, READ_SDO, ADDRESS, STATE, ENCODER = 0, 1, 2, 3, 4, 5, 6, 7, 9
SENSORLESS_ERROR = READ_SDO  # of firmware 0.5
MODE, POSITION, VELOCITY, TORQUE, LIMITS, TOP_SPEED, RAMPS, INERTIA = (0x0B, 0x0C, 0x0D, 0x0E, 0x0F, 0x11, 0x12, 0x13)
IQ, TEMPERATURE, REBOOT, BUS, CLEAR, ABSOLUTE, POSITION_GAIN, VELOCITY_GAINS = (0x14, 0x15, 0x16, 0x17, 0x18, 0x19, 0x1A, 0x1B)
TORQUES, POWERS, UPDATE = 0x1C, 0x1D, 0x1F
COMMANDS = {  # layouts of what the host sends
    WRITE_SDO: "<BHx4s",
    ADDRESS: "<B6s",
    STATE: "<I",
    MODE: "<II",
    POSITION: "<fhh",
    **dict.fromkeys((VELOCITY, LIMITS, RAMPS, VELOCITY_GAINS), "<ff"),
    **dict.fromkeys((TORQUE, TOP_SPEED, INERTIA, ABSOLUTE, POSITION_GAIN), "<f"),
    **dict.fromkeys((ESTOP, CLEAR, REBOOT, UPDATE), "<"),
}
IDLE, CLOSED_LOOP = 1, 8
TORQUE_CONTROL, VELOCITY_CONTROL, POSITION_CONTROL = 1, 2, 3
TRAJECTORY = 5  # an input mode
RESTARTED, SAVED, ERASED = 0, 1, 2  # actions of REBOOT
SUPPLY_LOW, OVER_CURRENT, OVER_HEATED, TOO_FAST = 0x200, 0x1000, 0x4000, 0x8000
WATCHDOG, STOPPED = 0x100_0000, 0x200_0000
SUCCESS, DISARMED, NOT_CALIBRATED = 0, 3, 14
BROADCAST = 63
ARM_S = 0.002  # until a state that was asked for is entered
BOOT_S = 0.15
FIRMWARE = (0, 6, 10)
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
    serial: bytes = b"ODRV01"
    periods_s: tuple[tuple[int, float], ...] = (
        (HEARTBEAT, 0.01),
        (ENCODER, 0.004),
        (IQ, 0.004),
        (BUS, 0.01),
        (TEMPERATURE, 0.1),
        (GET_ERROR, 0.1),
    )


class OdriveMock:
    """One axis. `read_turns` gives the angle of its encoder in turns."""

    def __init__(self, setup: OdriveSetup, read_turns: Callable[[], float]) -> None:
        self.setup = setup
        self.outgoing: list[Frame] = []
        self.is_home = False  # no message tells of it
        self.forced_error = 0  # a persistent cause, set by a fault of the scenario
        self._shift_turns = 0.0
        self._read_turns: Callable[[], float] = lambda: read_turns() + self._shift_turns
        self.node = setup.node
        self._stored: dict[int, bytes] = {}
        self.power_up(None)

    def power_up(self, now_s: float | None) -> None:
        """State after power-up or a restart; it is deaf and silent while it boots."""
        start_s = 0.0 if now_s is None else now_s
        self.state, self.errors, self.result = IDLE, 0, SUCCESS
        self.output = OPEN
        self.control, self._input_mode = POSITION_CONTROL, 1  # as stored
        self.endpoints = dict(self._stored)  # settings by the numbers of its firmware
        self._trajectory = {TOP_SPEED: (2.0,), RAMPS: (0.5, 0.5), INERTIA: (0.0,), VELOCITY_GAINS: (0.0, 0.0)}
        self._target = 0.0
        self.limit_A, self._limit_turns_s = self.setup.limit_A, math.inf
        self._torque_Nm = self._current_A = 0.0
        self._supply_V = 24.0
        self._motor = ServoMotor(self.setup.torque_constant_Nm_A, self._read_turns, speed_gain=TUNED_SPEED_GAIN)
        self._arms_at_s = math.inf
        self._heard_s = start_s
        self._boots_until_s = -math.inf if now_s is None else now_s + BOOT_S
        self._next_s = dict.fromkeys((command for command, _ in self.setup.periods_s), start_s)

    # ---- frames

    def receive(self, can_id: int, payload: bytes, now_s: float, is_remote: bool = False) -> None:
        """Process a frame with an 11-bit id; a remote one asks for a message."""
        command, is_update = can_id & 0x1F, self._boots_until_s == math.inf
        if can_id >> 5 not in (self.node, BROADCAST) or is_update or now_s < self._boots_until_s:
            return
        if self.setup.is_firmware_5 and command == SENSORLESS_ERROR and not payload:
            self._send(command, bytes(8))
        elif command in COMMANDS and not is_remote and len(payload) >= struct.calcsize(COMMANDS[command]):
            self._obey(command, struct.unpack_from(COMMANDS[command], payload), payload, now_s)
        elif command == ADDRESS and not payload:
            self._send(ADDRESS, bytes((self.node,)) + self.setup.serial + b"\0")
        elif is_remote:
            self._tell(command)

    def _obey(self, command: int, values: tuple[Any, ...], payload: bytes, now_s: float) -> None:
        motor = self._motor
        match command:
            case _ if command == STATE:
                self._ask(values[0], now_s)
            case _ if command == MODE:
                self.control, self._input_mode = values
                motor.ramp_turns_s = 0.0
            case _ if command == POSITION:
                self._target, motor.goal_turns_s, self._torque_Nm = values[0], 1e-3 * values[1], 1e-3 * values[2]
            case _ if command == VELOCITY:
                motor.goal_turns_s, self._torque_Nm = values
            case _ if command == TORQUE:
                (self._torque_Nm,) = values
            case _ if command == LIMITS:
                self._limit_turns_s, self.limit_A = values
            case _ if command in self._trajectory:
                self._trajectory[command] = values
            case _ if command == POSITION_GAIN:
                (motor.position_rate,) = values
            case _ if command == ABSOLUTE:
                self._shift_turns += values[0] - motor.turns
                motor.turns = self._read_turns()
            case _ if command == WRITE_SDO:
                is_write, endpoint, value = values
                if is_write:
                    self.endpoints[endpoint] = value
                self._send(READ_SDO, struct.pack("<BHx4s", 0, endpoint, self.endpoints.get(endpoint, bytes(4))))
            case _ if command == ADDRESS and values[1] == self.setup.serial:
                self.node = values[0]
            case _ if command == ESTOP:
                self._disarm(STOPPED)
            case _ if command == CLEAR:
                self.errors = 0
            case _ if command == REBOOT:
                action = payload[0] if payload else RESTARTED
                self._stored = {SAVED: self.endpoints, ERASED: {}}.get(action, self._stored)
                self.power_up(now_s)
            case _ if command == UPDATE:
                self.power_up(now_s)
                self._boots_until_s = math.inf  # waits for a firmware
        if command in (POSITION, VELOCITY, TORQUE, CLEAR):
            self._heard_s = now_s

    def _send(self, command: int, payload: bytes) -> None:
        self.outgoing.append((self.node << 5 | command, payload))

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

    def _tell(self, command: int) -> None:
        """Send a message of its own."""
        motor, wanted_A = self._motor, self._torque_Nm / self.setup.torque_constant_Nm_A
        measured_Nm = self._current_A * self.setup.torque_constant_Nm_A
        volts = self.output.value if self.output.kind == "voltage" else 0.0
        is_there = self._input_mode == TRAJECTORY and motor.goal_turns == self._target
        pairs = {
            ENCODER: (motor.turns, motor.speed_turns_s),
            IQ: (wanted_A, self._current_A),
            BUS: (self._supply_V, 0.0),
            TEMPERATURE: (35.0, math.nan),  # no thermistor in the motor
            TORQUES: (self._torque_Nm, measured_Nm),
            POWERS: (volts * self._current_A, 2.0 * math.pi * motor.speed_turns_s * measured_Nm),
        }
        if command in pairs:
            self._send(command, struct.pack("<ff", *pairs[command]))
        elif command == HEARTBEAT:
            self._send(command, struct.pack("<IBBBx", self.errors, self.state, self.result, is_there))
        elif command == GET_ERROR:
            self._send(command, struct.pack("<II", self._cause, self.errors))
        elif command == VERSION:
            self._send(command, bytes((2, 4, 4, 58, *FIRMWARE, 0)))

    # ---- control

    def tick(self, now_s: float, current_A: float, supply_V: float) -> None:
        """Run one control period."""
        self._motor.measure(now_s)
        self._current_A, self._supply_V = current_A, supply_V
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
        if self.state == CLOSED_LOOP and abs(self._motor.speed_turns_s) > SPEED_TOLERANCE * self._limit_turns_s:
            self._disarm(TOO_FAST)
        self.output = self._driven(supply_V) if self.state == CLOSED_LOOP else OPEN
        for command, period_s in self.setup.periods_s:
            if now_s >= self._next_s[command]:
                self._next_s[command] += period_s
                self._tell(command)

    def _enter(self) -> None:
        """Closed-loop control begins where the motor is."""
        self.state, self._arms_at_s = CLOSED_LOOP, math.inf
        self._target = self._motor.goal_turns = self._motor.turns
        self._motor.goal_turns_s = 0.0
        self._motor.engage()

    def _driven(self, supply_V: float) -> Output:
        if self.control == VELOCITY_CONTROL:
            self._motor.goal_turns = self._motor.turns
        elif self._input_mode == TRAJECTORY:
            self._motor.follow_ramp(self._target, *self._trajectory[RAMPS], *self._trajectory[TOP_SPEED])
        else:
            self._motor.goal_turns = self._target
        if self.control in (POSITION_CONTROL, VELOCITY_CONTROL):
            return self._motor.controlled(supply_V, abs(self._current_A) > LIMITED_SHARE * self.limit_A)
        wanted_A = self._torque_Nm / self.setup.torque_constant_Nm_A
        limited_A = min(max(wanted_A, -self.limit_A), self.limit_A)
        return Output("current", limited_A) if limited_A else OPEN
