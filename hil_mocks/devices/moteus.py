"""A moteus controller on CAN FD, written from moteus' CAN protocol, register, diagnostic and configuration references.

A state machine without I/O: `receive` frames, `tick` once per control period, read `output`. Its position loop is that of a board
tuned on the bench. A field that stands still (modes PWM, voltage and voltage FOC, fixed voltage) pulls the rotor to its angle, of
as many pole pairs as are stored. Of its console it knows `conf` and `tel`, and one channel of telemetry.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from hil_mocks.devices.motor_inputs import BRAKE, OPEN, Frame, Output
from hil_mocks.devices.servo_motor import TUNED_SPEED_GAIN, ServoMotor

STOPPED, FAULT, PWM, VOLTAGE, VOLTAGE_FOC, VOLTAGE_DQ, CURRENT, POSITION, TIMEOUT = (0, 1, 5, 6, 7, 8, 9, 10, 11)
ZERO_VELOCITY, STAY_WITHIN, BRAKED = 12, 13, 15
DRIVEN = (PWM, VOLTAGE, VOLTAGE_FOC, VOLTAGE_DQ, CURRENT, POSITION, ZERO_VELOCITY, STAY_WITHIN)
Q_CURRENT, SET_NEAREST, SET_EXACT, REINDEX, RECAPTURE = 0x01C, 0x130, 0x131, 0x132, 0x133
RELATIVE, ROTOR, OUTPUT = 0, 1, 2  # home states
DRIVER_FAULT, OVER_VOLTAGE, OVER_HEATED, SUPPLY_LOW, NO_ACCEL_LIMIT = 33, 34, 38, 40, 47
LIMITED_SHARE = 0.98  # of the current limit: more is at the limit
NOP, TEXT_TO, TEXT_FROM, ASK_TEXT, FLOW_FROM, ASK_FLOW = 0x50, 0x40, 0x41, 0x42, 0x43, 0x44
_HALF = 1 << 31  # of the range of the counter of milliseconds
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
FLOW_HEAD = 4  # bytes before a text: kind, channel, packet number, length
BOOT_S = 0.15
THERE_TURNS = 1e-6  # of the goal to its target
LOWEST_SUPPLY_V, HIGHEST_SUPPLY_V = 9.0, 46.0
FORMATS = ("<b", "<h", "<i", "<f")
# Of a register's integers: int8, int16, int32.
_POSITION, _VELOCITY, _TORQUE, _CURRENT = ((1e-2, 1e-4, 1e-5), (0.1, 2.5e-4, 1e-5), (0.5, 1e-2, 1e-3), (1.0, 0.1, 1e-3))
_VOLTAGE, _SHARE, _TIME, _ACCELERATION = (
    (0.5, 0.1, 1e-3),
    (1 / 127, 1 / 32767, 1 / 2147483647),
    (1e-2, 1e-3, 1e-6),
    (0.05, 1e-3, 1e-5),
)
SCALES = {
    **dict.fromkeys((0x001, 0x006, 0x020, 0x026, 0x038, 0x03B, 0x040, 0x041, 0x050, SET_NEAREST, SET_EXACT), _POSITION),
    **dict.fromkeys((0x002, 0x01E, 0x021, 0x028, 0x039, 0x03C, 0x051), _VELOCITY),
    0x007: (10.0, 0.05, 1e-4),
    **dict.fromkeys((0x003, 0x022, 0x025, 0x042, 0x045), _TORQUE),
    0x029: _ACCELERATION,
    **dict.fromkeys((0x004, 0x005, 0x00A, 0x00E, Q_CURRENT, 0x01D, 0x02C), _CURRENT),
    **dict.fromkeys((0x027, 0x046), _TIME),
    **dict.fromkeys((0x00D, 0x014, 0x015, 0x016, 0x019, 0x01A, 0x01B, 0x02A), _VOLTAGE),
    **dict.fromkeys((0x010, 0x011, 0x012, 0x018, 0x023, 0x024, 0x02B, 0x043, 0x044, 0x047, 0x073, 0x075), _SHARE),
    **dict.fromkeys((*range(0x060, 0x065), *range(0x068, 0x06D), *range(0x076, 0x080)), _SHARE),
}
COMMAND = {  # registers that count with a mode in the same frame, and what they are without
    **dict.fromkeys((*range(0x010, 0x013), *range(0x014, 0x017), *range(0x018, 0x01F), 0x020, 0x021, 0x022, 0x027, 0x02D), 0.0),
    **dict.fromkeys((0x023, 0x024, 0x02B), 1.0),
    **dict.fromkeys((0x025, 0x026, 0x028, 0x029, 0x02A, 0x02C, 0x040, 0x041), math.nan),
}
SHADOWS = {0x042: 0x022, 0x043: 0x023, 0x044: 0x024, 0x045: 0x025, 0x046: 0x027, 0x047: 0x02B, 0x048: 0x02D}
KEPT = (0x05C, 0x05D, 0x071, *range(0x076, 0x080))  # pins and clock: without a mode
UUID, UUID_MASK = range(0x150, 0x154), range(0x154, 0x158)
TELEMETRY = "servo_stats"
# Its schema: an object (type 16) of an unsigned byte (4), a boolean (2) and a float (7): flags, name, aliases, type, no default.
SCHEMA = b"\x10\0" + b"".join(
    bytes((0, len(name))) + name + b"\0" + kind + b"\0"
    for name, kind in ((b"mode", b"\x04\x01"), (b"trajectory_done", b"\x02"), (b"position", b"\x07"), (b"", b"\0"))
)


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
            "motor.Kv": f"{kv:.6f}",
            "motor_position.rotor_to_output_ratio": "1.000000",
            "servo.timeout_mode": str(self.timeout_mode),
            "servo.default_timeout_s": f"{self.timeout_s:.6f}",
            "servo.voltage_mode_control": "0",
            "servo.fixed_voltage_mode": "0",
            "servo.default_velocity_limit": "nan",
            "servo.default_accel_limit": f"{self.accel_limit_turns_s2:.6f}",
            "servo.bemf_feedforward": f"{self.bemf_feedforward:.6f}",
            "motor.poles": "14",
            "servo.max_current_A": f"{self.limit_A:.6f}",
            "aux1.pins.0.mode": "14" if self.home_switch else "0",
        }


class MoteusMock:
    """One controller. `read_turns` gives the angle of its output in turns."""

    def __init__(self, setup: MoteusSetup, read_turns: Callable[[], float]) -> None:
        self.setup = setup
        self.outgoing: list[Frame] = []
        self.forced_error = 0  # a persistent cause, set by a fault of the scenario
        self.is_home = False  # pin 1 of aux1
        self._read_turns: Callable[[], float] = lambda: read_turns() + self._shift_turns
        self.settings = self._written_settings = setup.stored()
        self._current_A, self._supply_V = 0.0, 24.0
        self.power_up(None)

    @property
    def limit_A(self) -> float:
        """The largest current: in the modes of a position, what the command's largest torque allows."""
        most_Nm: float = self._command[0x025]
        if self.mode not in (POSITION, STAY_WITHIN) or math.isnan(most_Nm):
            return self.setup.limit_A
        return min(self.setup.limit_A, most_Nm / self.setup.torque_constant_Nm_A)

    def power_up(self, now_s: float | None) -> None:
        """State after power-up or a restart; it is deaf while it boots."""
        self.mode, self.fault = STOPPED, 0
        self.output = OPEN
        self._began_s = 0.0 if now_s is None else now_s
        self._boots_until_s = -math.inf if now_s is None else now_s + BOOT_S
        self._now_s = self._began_s
        self._command, self._began_mode_s = dict(COMMAND), 0.0
        self._expires_s = math.inf
        self._shift_turns = 0.0
        self._target = 0.0  # to which the position goes by the limit of acceleration
        self._motor = ServoMotor(self.setup.torque_constant_Nm_A, self._read_turns, speed_gain=TUNED_SPEED_GAIN)
        self.settings = dict(self._written_settings)
        self.home_state = self.setup.home_state
        self.kept: dict[int, float] = dict.fromkeys(KEPT, 0)
        self._typed = self._says = b""  # to its console and by it
        self._flow = (0, b"")  # number and text of what was said last, until it is acknowledged

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
            if kind in (TEXT_TO, ASK_TEXT, ASK_FLOW):
                _, at = _varuint(payload, at)  # the channel
                acknowledged, at = (payload[at], at + 1) if kind == ASK_FLOW else (0, at)
                length, at = _varuint(payload, at)
                typed, at = (payload[at : at + length], at + length) if kind == TEXT_TO else (b"", at)
                if self.setup.has_console:
                    texts += self._converse(kind, typed, length, acknowledged)
                continue
            if not count:
                count, at = _varuint(payload, at)
            first, at = _varuint(payload, at)
            if kind & 0xF0 == 0x10:
                wanted.append((type_, first, count))
                continue
            for register in range(first, first + count):
                raw = struct.unpack_from(FORMATS[type_], payload, at)[0]
                if register in UUID_MASK and raw != self._registers()[register - UUID_MASK.start + UUID.start]:
                    return b""  # for another one
                written[register] = _from_raw(register, type_, raw)
                at += struct.calcsize(FORMATS[type_])
        values = self._registers() if wanted else {}
        reply = b"".join(self._reply(values, *one) for one in wanted) + texts
        self.kept |= {register: written[register] for register in written.keys() & self.kept.keys()}
        if 0x000 in written:
            self._obey(int(written[0x000]), written)
        for register in written.keys() & {SET_NEAREST, SET_EXACT}:
            self._set_output(written[register], register == SET_NEAREST)
        if REINDEX in written:
            self.home_state = RELATIVE
        if RECAPTURE in written and self.mode == POSITION:
            self._motor.engage()
            self._target = self._motor.goal_turns = self._motor.turns
        return reply

    def _converse(self, kind: int, typed: bytes, length: int, acknowledged: int) -> bytes:
        """Text to its console, or what it says; with flow control again and again, until that is acknowledged."""
        if kind == TEXT_TO:
            *lines, self._typed = (self._typed + typed).split(b"\n")
            for line in lines:
                self._says += self._said(*line.decode().split())
            return b""
        if kind == ASK_FLOW and acknowledged != self._flow[0]:
            text = self._flow[1]
        else:
            length = min(length, FD_LENGTHS[-1] - FLOW_HEAD)
            text, self._says = self._says[:length], self._says[length:]
            self._flow = (self._flow[0] % 255 + 1, text) if kind == ASK_FLOW else self._flow
        head = bytes((TEXT_FROM, 1)) if kind == ASK_TEXT else bytes((FLOW_FROM, 1, self._flow[0]))
        return head + bytes((len(text),)) + text

    def _said(self, *words: str) -> bytes:
        """To a line typed to its console."""
        match words:
            case "conf", "get", name if name in self.settings:
                return self.settings[name].encode() + b"\r\n"
            case "conf", "set", name, value if name in self.settings:
                self.settings[name] = value
            case "conf", "enumerate":
                lines = "".join(f"{name} {value}\r\n" for name, value in self.settings.items())
                return f"{lines}OK\r\n".encode()
            case "conf", "write":
                self._written_settings = dict(self.settings)
            case "conf", "load":
                self.settings = dict(self._written_settings)
            case "conf", "default":
                self.settings = self.setup.stored()
            case "tel", "list":
                return f"{TELEMETRY}\r\nOK\r\n".encode()
            case "tel", "schema", name if name == TELEMETRY:
                return f"schema {name}\r\n".encode() + struct.pack("<I", len(SCHEMA)) + SCHEMA
            case "tel", "fmt", name, _ if name == TELEMETRY:
                pass
            case "tel", "get", name if name == TELEMETRY:
                seen = struct.pack("<B?f", self.mode, bool(self._is_there), self._motor.turns)
                return f"emit {name}\r\n".encode() + struct.pack("<I", len(seen)) + seen
            case "conf" | "tel", *_:
                return b"ERR error reading\r\n"
            case _:
                return b"ERR unknown command\r\n"
        return b"OK\r\n"

    def _obey(self, mode: int, written: dict[int, float]) -> None:
        """Enter a mode. A fault and a time-out are left by STOPPED alone."""
        if mode == STOPPED:
            self.mode, self.fault = STOPPED, 0
            self._expires_s = math.inf
        elif self.mode in (FAULT, TIMEOUT):
            return
        elif mode == BRAKED:
            self.mode, self._expires_s = BRAKED, math.inf
        elif mode in DRIVEN:
            commanded = {SHADOWS.get(register, register): value for register, value in written.items()}
            unsaid = {} if mode == POSITION else {0x020: math.nan}
            self._control(mode, COMMAND | unsaid | commanded, self._now_s)

    def _set_output(self, turns: float, is_nearest: bool) -> None:
        """The position is this from now on; `is_nearest`: by whole turns of the rotor, which is the output here."""
        shift = turns - self._motor.turns
        self._shift_turns += round(shift) if is_nearest else shift
        self.home_state = OUTPUT
        self._motor.turns = self._read_turns()

    def switch_torque(self, is_on: bool, now_s: float) -> None:
        """Another program holds the motor where it is, without a time-out, or stops it."""
        self._now_s = now_s
        self._obey(POSITION if is_on else STOPPED, {0x020: math.nan, 0x027: math.nan})

    def _control(self, mode: int, command: dict[int, float], now_s: float) -> None:
        motor = self._motor
        if self.mode != mode:
            motor.engage()
            motor.goal_turns = motor.turns
        self.mode, self._command, self._began_mode_s = mode, command, now_s
        if float(self.settings["servo.bemf_feedforward"]) and math.isinf(self._accel_turns_s2) and mode == POSITION:
            self.mode, self.fault = FAULT, NO_ACCEL_LIMIT
        self._target = motor.goal_turns if math.isnan(command[0x020]) else command[0x020]
        if math.isinf(self._accel_turns_s2):
            motor.goal_turns = self._target
        motor.goal_turns_s = 0.0 if math.isnan(command[0x021]) else command[0x021]
        timeout_s = command[0x027] or float(self.settings["servo.default_timeout_s"])
        self._expires_s = math.inf if math.isnan(timeout_s) else now_s + timeout_s

    @property
    def _accel_turns_s2(self) -> float:
        """By which it goes to a position: of the command, else as stored; negative: at once."""
        commanded = self._command[0x029]
        limit = float(self.settings["servo.default_accel_limit"]) if math.isnan(commanded) else commanded
        return math.inf if math.isnan(limit) or limit < 0.0 else limit

    @property
    def _is_there(self) -> bool:
        return abs(self._target - self._motor.goal_turns) < THERE_TURNS

    def _reply(self, values: dict[int, float], type_: int, first: int, count: int) -> bytes:
        packed = b""
        for register in range(first, first + count):
            if register not in values or register in self.setup.unknown:
                return bytes((0x31,)) + _as_varuint(register) + b"\x01"
            packed += struct.pack(FORMATS[type_], _to_raw(register, type_, values[register]))
        head = bytes((0x20 | type_ << 2 | count,)) if count < 4 else bytes((0x20 | type_ << 2, count))
        return head + _as_varuint(first) + packed

    def _registers(self) -> dict[int, float]:
        motor, setup = self._motor, self.setup
        torque_Nm = self._current_A * setup.torque_constant_Nm_A
        off = (motor.turns - motor.goal_turns, motor.speed_turns_s - motor.goal_turns_s)
        return {
            **self._command,
            **{shadow: self._command[register] for shadow, register in SHADOWS.items()},
            **self.kept,
            **dict.fromkeys((0x005, 0x006, 0x00A, *range(0x030, 0x035), 0x03A, 0x03D, 0x05F, 0x072, 0x074, 0x140, 0x141), 0),
            **dict.fromkeys((*range(0x052, 0x056), *range(0x060, 0x065), *range(0x068, 0x06D)), 0),
            0x073: math.nan,
            0x075: math.nan,
            0x000: self.mode,
            0x001: motor.turns,
            0x002: motor.speed_turns_s,
            0x003: torque_Nm,
            0x004: self._current_A,
            0x007: self.output.value * self._current_A if self.output.kind == "voltage" else 0.0,
            0x00B: int(self._is_there),
            0x00C: self.home_state,
            0x00D: self._supply_V,
            0x00E: 35.0,
            0x00F: self.fault,
            0x038: motor.goal_turns,
            0x039: motor.goal_turns_s,
            0x03B: off[0],
            0x03C: off[1],
            0x050: motor.turns,
            0x051: motor.speed_turns_s,
            0x058: 3,
            0x05E: int(self.is_home),
            0x070: self.milliseconds,
            0x100: 4,
            0x101: setup.firmware,
            0x102: 5,
            0x110: setup.number,
            **{0x120 + k: word for k, word in enumerate(setup.serial)},
            **{register: setup.serial[k % 3] + k for k, register in enumerate(UUID)},
            0x158: 1,
        }

    # ---- control

    def tick(self, now_s: float, current_A: float, supply_V: float) -> None:
        """Run one control period."""
        motor, step_s = self._motor, now_s - self._now_s
        self._now_s, self._current_A, self._supply_V = now_s, current_A, supply_V
        motor.measure(now_s)
        if now_s < self._boots_until_s:
            return
        if self.mode in DRIVEN and now_s > self._expires_s:
            self.mode = TIMEOUT
            motor.goal_turns, motor.goal_turns_s = motor.turns, 0.0
        if self.mode not in (STOPPED, FAULT) and (cause := self._cause(supply_V)):
            self.mode, self.fault = FAULT, cause
        if self.mode == POSITION and math.isfinite(self._accel_turns_s2) and step_s > 0.0:
            fastest = self._command[0x028]
            if math.isnan(fastest):
                fastest = float(self.settings["servo.default_velocity_limit"])
            limit = self._accel_turns_s2
            motor.follow_ramp(self._target, limit, limit, fastest if fastest >= 0.0 else math.inf)
        else:
            self._move_on(motor.goal_turns_s * max(step_s, 0.0))
        self.output = self._driven(supply_V)

    def _move_on(self, turns: float) -> None:
        """At the commanded speed, up to the stop position."""
        motor, stop = self._motor, self._command[0x026]
        left = stop - motor.goal_turns
        if self.mode == POSITION and abs(turns) >= abs(left) and turns * left >= 0.0:
            motor.goal_turns, motor.goal_turns_s = stop, 0.0
        else:
            motor.goal_turns += turns

    def _cause(self, supply_V: float) -> int:
        if supply_V < LOWEST_SUPPLY_V:
            return SUPPLY_LOW
        return OVER_VOLTAGE if supply_V > HIGHEST_SUPPLY_V else self.forced_error

    def _driven(self, supply_V: float) -> Output:
        mode = int(self.settings["servo.timeout_mode"]) if self.mode == TIMEOUT else self.mode
        command, motor = self._command, self._motor
        match mode:
            case 0 | 1:
                return OPEN
            case _ if mode == BRAKED:
                return BRAKE
            case _ if mode == PWM:
                return self._pulled(*_field(*(supply_V * command[register] for register in range(0x010, 0x013))))
            case _ if mode == VOLTAGE:
                return self._pulled(*_field(*(command[register] for register in range(0x014, 0x017))))
            case _ if mode == VOLTAGE_FOC:
                turned = command[0x01E] * (self._now_s - self._began_mode_s)
                return self._pulled(math.pi * (command[0x018] + turned), command[0x019])
            case _ if mode == VOLTAGE_DQ:
                return Output("voltage", command[0x01B])
            case _ if mode == CURRENT:
                return self._current(command[Q_CURRENT])
            case _ if mode == ZERO_VELOCITY:
                motor.goal_turns = motor.turns
        if self.mode == TIMEOUT or mode == ZERO_VELOCITY:
            return motor.controlled(supply_V)
        if mode == STAY_WITHIN:
            nearest = max(min(motor.turns, _or(command[0x041], math.inf)), _or(command[0x040], -math.inf))
            if nearest == motor.turns:
                return self._current(command[0x022] / self.setup.torque_constant_Nm_A)
            motor.goal_turns = nearest
        if not math.isnan(command[0x02A]):
            return self._pulled(math.pi * self._poles * motor.goal_turns, command[0x02A])
        if command[0x023]:
            return motor.controlled(supply_V, abs(self._current_A) > LIMITED_SHARE * self.limit_A)
        return self._current(command[0x022] / self.setup.torque_constant_Nm_A)

    @property
    def _poles(self) -> int:
        return int(self.settings["motor.poles"])

    def _pulled(self, theta_rad: float, volts: float) -> Output:
        """A field at an electrical angle turns the rotor towards itself: by the part of its voltage that is across the rotor."""
        return Output("voltage", volts * math.sin(theta_rad - math.pi * self._poles * self._motor.turns))

    def _current(self, wanted_A: float) -> Output:
        limited_A = min(max(wanted_A, -self.limit_A), self.limit_A)
        return Output("current", limited_A) if limited_A else OPEN


def _or(value: float, otherwise: float) -> float:
    return otherwise if math.isnan(value) else value


def _field(a: float, b: float, c: float) -> tuple[float, float]:
    """Electrical angle and size of the field of three phases (Clarke)."""
    alpha, beta = (2.0 * a - b - c) / 3.0, (b - c) / math.sqrt(3.0)
    return math.atan2(beta, alpha), math.hypot(alpha, beta)


def _from_raw(register: int, type_: int, raw: float) -> float:
    """A value from its number; the most negative integer is NaN."""
    if type_ == 3 or register not in SCALES:
        return raw
    return math.nan if raw == -(1 << (8 << type_) - 1) else raw * SCALES[register][type_]


def _to_raw(register: int, type_: int, value: float) -> float:
    if type_ == 3:
        return float(value)
    bits = 8 << type_
    if math.isnan(value):
        return -(1 << bits - 1)
    raw = round(value / SCALES[register][type_]) if register in SCALES else int(value)
    if 0x120 <= register <= 0x122 or register in UUID:
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
