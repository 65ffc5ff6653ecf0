"""A moteus controller on CAN FD, written from moteus' CAN protocol, register, diagnostic and configuration references.

A state machine without I/O: `receive` frames, `tick` once per control period, read `output`. Its position loop is that of a board
tuned on the bench; registers that no test needs are unknown to it. Of its console it knows `conf get`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from hil_mocks.devices.motor_inputs import BRAKE, OPEN, Frame, Output
from hil_mocks.devices.servo_motor import ServoMotor

STOPPED, FAULT, CURRENT, POSITION, TIMEOUT, ZERO_VELOCITY, BRAKED = 0, 1, 9, 10, 11, 12, 15
Q_CURRENT, SET_NEAREST, SET_EXACT = 0x01C, 0x130, 0x131
DRIVER_FAULT, OVER_VOLTAGE, OVER_HEATED, SUPPLY_LOW, NO_ACCEL_LIMIT = 33, 34, 38, 40, 47
LIMITED_SHARE = 0.98  # of the current limit: more is at the limit
NOP, TEXT_TO, TEXT_FROM, ASK_TEXT = 0x50, 0x40, 0x41, 0x42
_HALF = 1 << 31  # of the range of the counter of milliseconds
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
BOOT_S = 0.15
LOWEST_SUPPLY_V, HIGHEST_SUPPLY_V = 9.0, 46.0
FORMATS = ("<b", "<h", "<i", "<f")
SCALES = {  # of a register's integers: int8, int16, int32
    0x001: (1e-2, 1e-4, 1e-5), 0x002: (0.1, 2.5e-4, 1e-5), 0x003: (0.5, 1e-2, 1e-3), 0x004: (1.0, 0.1, 1e-3),
    0x00D: (0.5, 0.1, 1e-3), 0x00E: (1.0, 0.1, 1e-3), 0x020: (1e-2, 1e-4, 1e-5), 0x021: (0.1, 2.5e-4, 1e-5),
    0x022: (0.5, 1e-2, 1e-3), 0x023: (1 / 127, 1 / 32767, 1 / 2147483647), 0x024: (1 / 127, 1 / 32767, 1 / 2147483647),
    0x025: (0.5, 1e-2, 1e-3), 0x027: (1e-2, 1e-3, 1e-6), 0x028: (0.1, 2.5e-4, 1e-5),
    0x029: (0.05, 1e-3, 1e-5), 0x02B: (1 / 127, 1 / 32767, 1 / 2147483647),
    Q_CURRENT: (1.0, 0.1, 1e-3), SET_NEAREST: (1e-2, 1e-4, 1e-5), SET_EXACT: (1e-2, 1e-4, 1e-5),
}  # fmt: skip
COMMAND = {
    0x020: 0.0,
    0x021: 0.0,
    0x022: 0.0,
    0x023: 1.0,
    0x024: 1.0,
    0x025: math.nan,
    0x027: 0.0,
    0x028: math.nan,
    0x029: math.nan,
    0x02B: 1.0,
}


@dataclass(frozen=True, slots=True)
class MoteusSetup:
    """Motor, identity and settings. `home_switch`: whether pin 1 of aux1 is set up for it."""

    number: int
    torque_constant_Nm_A: float
    limit_A: float
    serial: tuple[int, int, int] = (1, 2, 3)
    firmware: int = 0x010304
    home_state: int = 1  # referenced to the rotor
    timeout_s: float = 0.1
    timeout_mode: int = POSITION  # slow down and hold
    home_switch: bool = True
    accel_limit_turns_s2: float = 50.0  # as delivered; a command may carry another one
    bemf_feedforward: float = 0.0  # 1 as delivered by older firmware
    unknown: tuple[int, ...] = ()  # registers that its firmware does not have
    has_console: bool = True

    def stored(self) -> dict[str, str]:
        """Its settings, as `conf get` gives them. Kv: peak voltage between two phases, as moteus_tool finds it."""
        kv = 30.0 / math.pi * math.cos(math.pi / 6.0) / self.torque_constant_Nm_A
        return {
            "motor.Kv": f"{kv:.6f}", "motor_position.rotor_to_output_ratio": "1.000000",
            "servo.timeout_mode": str(self.timeout_mode), "servo.default_timeout_s": f"{self.timeout_s:.6f}",
            "servo.voltage_mode_control": "0", "servo.fixed_voltage_mode": "0",
            "servo.default_velocity_limit": "nan",
            "servo.default_accel_limit": f"{self.accel_limit_turns_s2:.6f}",
            "servo.bemf_feedforward": f"{self.bemf_feedforward:.6f}",
            "servo.max_current_A": f"{self.limit_A:.6f}", "aux1.pins.0.mode": "14" if self.home_switch else "0",
        }  # fmt: skip


class MoteusMock:
    """One controller. `read_turns` gives the angle of its output in turns."""

    def __init__(self, setup: MoteusSetup, read_turns: Callable[[], float]) -> None:
        self.setup = setup
        self.outgoing: list[Frame] = []
        self.forced_error = 0  # a persistent cause, set by a fault of the scenario
        self.is_home = False  # pin 1 of aux1
        self._read_turns: Callable[[], float] = lambda: read_turns() + self._shift_turns
        self._current_A, self._supply_V = 0.0, 24.0
        self.power_up(None)

    @property
    def limit_A(self) -> float:
        """The largest current: in position mode, what the command's largest torque allows."""
        most_Nm = self._command[0x025]
        if self.mode != POSITION or math.isnan(most_Nm):
            return self.setup.limit_A
        return min(self.setup.limit_A, most_Nm / self.setup.torque_constant_Nm_A)

    def power_up(self, now_s: float | None) -> None:
        """State after power-up or a restart; it is deaf while it boots."""
        self.mode, self.fault = STOPPED, 0
        self.output = OPEN
        self._began_s = 0.0 if now_s is None else now_s
        self._boots_until_s = -math.inf if now_s is None else now_s + BOOT_S
        self._now_s = self._began_s
        self._command = dict(COMMAND)
        self._expires_s = math.inf
        self._shift_turns = self._q_current_A = 0.0
        self._target = self._goal_turns_s = 0.0  # of a position that is gone to by the limit of acceleration
        self._motor = ServoMotor(self.setup.torque_constant_Nm_A, self._read_turns)
        self._typed = self._says = b""  # to its console and by it

    @property
    def milliseconds(self) -> int:
        """Since the start; the counter wraps."""
        return (int((self._now_s - self._began_s) * 1e3) + _HALF) % (2 * _HALF) - _HALF

    def advance_counter(self, milliseconds: int) -> None:
        """As if the controller had been on for so much longer."""
        self._began_s -= 1e-3 * milliseconds

    # ---- frames

    def receive(self, can_id: int, payload: bytes, now_s: float) -> None:
        """Process a frame; the reply is sent at once."""
        if can_id & 0x7F not in (self.setup.number, 0x7F) or now_s < self._boots_until_s:
            return
        self._now_s = now_s
        reply = self._answered(payload)
        if can_id & 0x8000:
            length = next(length for length in FD_LENGTHS if length >= len(reply))
            padded = reply.ljust(length, bytes((NOP,)))
            self.outgoing.append((self.setup.number << 8 | can_id >> 8 & 0x7F, padded))

    def _answered(self, payload: bytes) -> bytes:
        """Answer what is read, and then obey what is written: a command is taken when its frame has been read."""
        written: dict[int, float] = {}
        wanted: list[tuple[int, int, int]] = []  # type, first register, count
        texts = b""
        at = 0
        while at < len(payload):
            kind = payload[at]
            at += 1
            if kind == NOP:
                continue
            type_, count = kind >> 2 & 3, kind & 3
            if kind in (TEXT_TO, ASK_TEXT):
                _, at = _varuint(payload, at)  # the channel
                length, at = _varuint(payload, at)
                if not self.setup.has_console:
                    at += 0 if kind == ASK_TEXT else length
                elif kind == ASK_TEXT:
                    said, self._says = self._says[:length], self._says[length:]
                    texts += bytes((TEXT_FROM, 1, len(said))) + said
                else:
                    self._type(payload[at : at + length])
                    at += length
                continue
            if not count:
                count, at = _varuint(payload, at)
            first, at = _varuint(payload, at)
            if kind & 0xF0 == 0x10:
                wanted.append((type_, first, count))
                continue
            for register in range(first, first + count):
                raw = struct.unpack_from(FORMATS[type_], payload, at)[0]
                written[register] = _from_raw(register, type_, raw)
                at += struct.calcsize(FORMATS[type_])
        reply = b"".join(self._reply(*one) for one in wanted) + texts
        if 0x000 in written:
            self._obey(int(written[0x000]), written)
        for register in written.keys() & {SET_NEAREST, SET_EXACT}:
            self._set_output(written[register], register == SET_NEAREST)
        return reply

    def _type(self, text: bytes) -> None:
        """Text to its console; lines are obeyed."""
        *lines, self._typed = (self._typed + text).split(b"\n")
        for line in lines:
            name = line.decode().removeprefix("conf get ").strip()
            self._says += (self.setup.stored().get(name, "ERR error reading") + "\r\n").encode()

    def _obey(self, mode: int, written: dict[int, float]) -> None:
        """Enter a mode. A fault and a time-out are left by STOPPED alone."""
        if mode == STOPPED:
            self.mode, self.fault = STOPPED, 0
            self._expires_s = math.inf
        elif self.mode in (FAULT, TIMEOUT):
            return
        elif mode == BRAKED:
            self.mode, self._expires_s = BRAKED, math.inf
        elif mode == POSITION:
            self._control(COMMAND | written, self._now_s)
        elif mode in (CURRENT, ZERO_VELOCITY):
            self._control(COMMAND | {0x020: math.nan} | written, self._now_s)
            self.mode, self._q_current_A = mode, written.get(Q_CURRENT, 0.0)

    def _set_output(self, turns: float, is_nearest: bool) -> None:
        """The position is this from now on; `is_nearest`: by whole turns of the rotor, which is the output here."""
        shift = turns - self._motor.turns
        self._shift_turns += round(shift) if is_nearest else shift
        self._motor.turns = self._read_turns()

    def switch_torque(self, is_on: bool, now_s: float) -> None:
        """Another program holds the motor where it is, without a time-out, or stops it."""
        self._now_s = now_s
        self._obey(POSITION if is_on else STOPPED, {0x020: math.nan, 0x027: math.nan})

    def _control(self, command: dict[int, float], now_s: float) -> None:
        motor = self._motor
        if self.mode != POSITION:
            motor.engage()
            motor.goal_turns, self._goal_turns_s = motor.turns, 0.0
        self.mode, self._command = POSITION, command
        if self.setup.bemf_feedforward and math.isinf(self._accel_turns_s2):
            self.mode, self.fault = FAULT, NO_ACCEL_LIMIT
        self._target = motor.goal_turns if math.isnan(command[0x020]) else command[0x020]
        if math.isinf(self._accel_turns_s2):
            motor.goal_turns = self._target
        motor.goal_turns_s = 0.0 if math.isnan(command[0x021]) else command[0x021]
        timeout_s = command[0x027] or self.setup.timeout_s
        self._expires_s = math.inf if math.isnan(timeout_s) else now_s + timeout_s

    @property
    def _accel_turns_s2(self) -> float:
        """By which it goes to a position: of the command, else as stored; negative: at once."""
        commanded = self._command[0x029]
        limit = self.setup.accel_limit_turns_s2 if math.isnan(commanded) else commanded
        return math.inf if math.isnan(limit) or limit < 0.0 else limit

    def _follow_ramp(self, step_s: float) -> None:
        """The goal goes to the target, faster and slower by the limit of acceleration."""
        limit, motor = self._accel_turns_s2, self._motor
        way = self._target - motor.goal_turns
        wanted = math.copysign(min(math.sqrt(2.0 * limit * abs(way)), abs(way) / step_s), way)
        self._goal_turns_s += min(max(wanted - self._goal_turns_s, -limit * step_s), limit * step_s)
        motor.goal_turns += self._goal_turns_s * step_s

    def _reply(self, type_: int, first: int, count: int) -> bytes:
        values = {
            register: value
            for register, value in self._registers().items()
            if register not in self.setup.unknown
        }
        packed = b""
        for register in range(first, first + count):
            if register not in values:
                return bytes((0x31,)) + _as_varuint(register) + b"\x01"
            packed += struct.pack(FORMATS[type_], _to_raw(register, type_, values[register]))
        head = bytes((0x20 | type_ << 2 | count,)) if count < 4 else bytes((0x20 | type_ << 2, count))
        return head + _as_varuint(first) + packed

    def _registers(self) -> dict[int, float]:
        motor, setup = self._motor, self.setup
        return {
            0x000: self.mode, 0x001: motor.turns, 0x002: motor.speed_turns_s,
            0x003: self._current_A * setup.torque_constant_Nm_A, 0x004: self._current_A, 0x005: 0.0,
            0x00B: 0, 0x00C: setup.home_state, 0x00D: self._supply_V, 0x00E: 35.0, 0x00F: self.fault,
            0x05E: int(self.is_home), 0x070: self.milliseconds, 0x100: 4,
            0x101: setup.firmware, 0x102: 5, **{0x120 + k: word for k, word in enumerate(setup.serial)},
        }  # fmt: skip

    # ---- control

    def tick(self, now_s: float, current_A: float, supply_V: float) -> None:
        """Run one control period."""
        motor, step_s = self._motor, now_s - self._now_s
        self._now_s, self._current_A, self._supply_V = now_s, current_A, supply_V
        motor.measure(now_s)
        if now_s < self._boots_until_s:
            return
        if self.mode in (CURRENT, POSITION, ZERO_VELOCITY) and now_s > self._expires_s:
            self.mode = TIMEOUT
            motor.goal_turns, motor.goal_turns_s = motor.turns, 0.0
        if self.mode not in (STOPPED, FAULT) and (cause := self._cause(supply_V)):
            self.mode, self.fault = FAULT, cause
        if self.mode == POSITION and math.isfinite(self._accel_turns_s2) and step_s > 0.0:
            self._follow_ramp(step_s)
        else:
            motor.goal_turns += motor.goal_turns_s * max(step_s, 0.0)
        self.output = self._driven(supply_V)

    def _cause(self, supply_V: float) -> int:
        if supply_V < LOWEST_SUPPLY_V:
            return SUPPLY_LOW
        return OVER_VOLTAGE if supply_V > HIGHEST_SUPPLY_V else self.forced_error

    def _driven(self, supply_V: float) -> Output:
        mode = self.setup.timeout_mode if self.mode == TIMEOUT else self.mode
        if mode == BRAKED:
            return BRAKE
        if mode == ZERO_VELOCITY:
            self._motor.goal_turns = self._motor.turns
        if (self.mode == TIMEOUT and mode != STOPPED) or mode == ZERO_VELOCITY:
            return self._motor.controlled(supply_V)
        if mode == CURRENT:
            return Output("current", min(max(self._q_current_A, -self.setup.limit_A), self.setup.limit_A))
        if self.mode != POSITION:
            return OPEN
        most_A = self.limit_A
        if self._command[0x023]:
            return self._motor.controlled(supply_V, abs(self._current_A) > LIMITED_SHARE * most_A)
        wanted_A = self._command[0x022] / self.setup.torque_constant_Nm_A
        limited_A = min(max(wanted_A, -most_A), most_A)
        return Output("current", limited_A) if limited_A else OPEN


def _from_raw(register: int, type_: int, raw: float) -> float:
    """A value from its number; the most negative integer is NaN."""
    if type_ == 3 or register not in SCALES:
        return raw
    return math.nan if raw == -(1 << (8 << type_) - 1) else raw * SCALES[register][type_]


def _to_raw(register: int, type_: int, value: float) -> float:
    if type_ == 3:
        return float(value)
    raw = round(value / SCALES[register][type_]) if register in SCALES else int(value)
    bits = 8 << type_
    if register in (0x120, 0x121, 0x122):
        return raw - (1 << bits) if raw >= 1 << bits - 1 else raw
    most = (1 << bits - 1) - 1
    return min(max(raw, -most), most)


def _varuint(payload: bytes, at: int) -> tuple[int, int]:
    number = shift = 0
    while True:
        byte = payload[at]
        number |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return number, at


def _as_varuint(number: int) -> bytes:
    return bytes((number,)) if number < 0x80 else bytes((number & 0x7F | 0x80, number >> 7))
