"""A CiA 402 drive on CANopen, written from CiA 301 and CiA 402 (IEC 61800-7-201): object dictionary, PDOs, states, modes.

A state machine without I/O: `receive` frames, `tick` once per control period, and read `output`. It has its own position loop,
as a drive that was tuned on the bench: position to speed, speed to voltage. It homes where it stands (methods 35 and 37), and has
no profile modes, block transfers or node guarding.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

from hil_mocks.devices.motor_inputs import NEXT, OPEN, Frame, MotorState, Output, Word, word_of

INITIALISING, STOPPED, PRE_OPERATIONAL, OPERATIONAL = 0x00, 0x04, 0x7F, 0x05
HOMING, CSP, CSV, CST = 6, 8, 9, 10
START_HOMING, HOMED = (0x10, 0x1400)  # bit 4 of the controlword; target reached and homing attained, of the statusword
POSITION_RATE, SPEED_RATE, SPEED_GAIN, SPEED_INTEGRAL = 20.0, 430.0, 2.0, 40.0  # 1/s; 1/s; - at most; 1/s
SPEED_FILTER_S = 0.0015
OVER_CURRENT, OVER_HEATED, SUPPLY_LOW, HEARTBEAT_LOST, FOLLOWING_ERROR = (0x2310, 0x4310, 0x3220, 0x8130, 0x8611)
NO_WINDOW, DID_NOT_FOLLOW = 0xFFFF_FFFF, 0x2000  # of 0x6065; bit 13 of the statusword in the position modes
NO_REMOTE_REQUESTS = 0x4000_0000  # bit of a TPDO's COB-ID that a drive without them keeps
_LOWEST_SUPPLY_V = 9.0
_FORMATS = {"u8": "<B", "i8": "<b", "u16": "<H", "i16": "<h", "u32": "<I", "i32": "<i"}
NO_OBJECT, NO_SUB, READ_ONLY, LENGTH, STATE = 0x06020000, 0x06090011, 0x06010002, 0x06070010, 0x08000022
OUT_OF_RANGE = 0x06090030
UNKNOWN_COMMAND, TOGGLE, NOT_STORED = 0x05040001, 0x05030000, 0x08000020
STORE, RESTORE = (0x1010, 1), (0x1011, 1)
SIGNATURES = {STORE: b"save", RESTORE: b"load"}
NAME = (0x1008, 0)
COMMANDED = (0x6040, 0x6060, 0x6071, 0x607A, 0x60FF)  # not stored
NOT_MAPPABLE = 0x06040041
MAXON, EPOS4 = 0x0000_00FB, 0x6050_0000
_READ_ONLY = {0x1000, 0x1018, 0x2200, 0x603F, 0x6041, 0x6061, 0x6064, 0x606C, 0x6075, 0x6076, 0x6077, 0x6079, 0x60FD, 0x6502}


@dataclass(frozen=True, slots=True)
class Cia402Setup:
    """Identity and motor data of a drive."""

    node: int
    serial_number: int
    counts_per_turn: int
    torque_constant_Nm_A: float
    resistance_ohm: float
    current_limit_A: float
    rotor_inertia_kg_m2: float = 0.0  # 0: not known
    rated_torque_Nm: float = 0.5
    vendor: int = 0x0000_0402
    product: int = 0x0000_0001
    fault_reaction: int = 2  # 0x605E: slow down by the quick stop ramp
    following_error_window: int = NO_WINDOW  # 0x6065
    following_error_ms: int = 0  # 0x6066: so long out of the window, and it is a following error
    modes: int = 0x03A0  # 0x6502: homing, cyclic synchronous position, velocity, torque
    position_unit: int = 0x00B5_0000  # 0x60A8: increments
    has_cycle_time: bool = True  # 0x60C2
    name: bytes = b"mock drive"  # 0x1008

    @property
    def is_epos4(self) -> bool:
        """Whether its dictionary is that of maxon's EDS (EPOS4, firmware 0x0170) and not the plain one of CiA 402."""
        return self.vendor == MAXON

    @property
    def speed_gain(self) -> float:
        """As the vendor's tool tunes it: the quicker the motor by itself, the less it takes."""
        motor_s = self.rotor_inertia_kg_m2 * self.resistance_ohm / self.torque_constant_Nm_A**2
        return min(SPEED_GAIN, SPEED_RATE * motor_s) if motor_s else SPEED_GAIN

    @property
    def rated_current_A(self) -> float:
        """With which the motor gives its rated torque."""
        return self.rated_torque_Nm / self.torque_constant_Nm_A


class Cia402Mock:
    """The drive of a joint. `read_shaft` gives the edges counted by its encoder, without wrap."""

    def __init__(self, setup: Cia402Setup, read_shaft: Callable[[], int]) -> None:
        self.setup = setup
        self._read_shaft = read_shaft
        self.forced_error = 0  # a persistent cause, set by a fault of the scenario
        self.is_home = False  # digital input "home switch"
        self.at_limits = (False, False)  # digital inputs "negative limit switch", "positive limit switch"
        self.outgoing: list[Frame] = []
        self._stored: dict[tuple[int, int], tuple[str, int]] = {}
        self.power_up()

    @property
    def limit_A(self) -> float:
        """The smaller of its current limit and what the host allows."""
        if self.setup.is_epos4:
            return min(self.setup.current_limit_A, self.objects[0x3001, 2][1] * 1e-3)
        torque_Nm = self.objects[0x6072, 0][1] * 1e-3 * self.setup.rated_torque_Nm
        return min(self.setup.current_limit_A, torque_Nm / self.setup.torque_constant_Nm_A)

    def power_up(self, now_s: float | None = None) -> None:
        """State after power-up or NMT reset: everything at its default, position 0, a boot-up message."""
        node = self.setup.node
        self.objects = _defaults(self.setup) | self._stored
        self._segments: tuple[int, bytes] = (0, b"")  # of an answer that is too long for a frame: toggle bit, what is left
        self._is_homed = False
        for pdo, base in ((0, 0x200), (1, 0x300)):
            self.objects[0x1400 + pdo, 1] = ("u32", base + node)
            self.objects[0x1800 + pdo, 1] = ("u32", 0x8000_0000 | NO_REMOTE_REQUESTS | base - 0x80 + node)
        self.nmt_state = PRE_OPERATIONAL
        self.state = MotorState.NOT_READY
        self.error = 0
        self.output = OPEN
        self._origin = self._read_shaft()
        self._before, self._speed, self._integral_V, self._torque_permille = self._origin, 0.0, 0.0, 0
        self._supply_V = 24.0
        self._word_before = 0x80
        self._pending: dict[int, bytes] = {}  # RPDO payloads that wait for SYNC, by number
        self._heard_s: float | None = None  # the host's heartbeat
        self._last_s: float | None = None
        self._beat_s = 0.0
        self._held = 0
        self._aim = self._since = self._target = 0  # of the interpolation
        self._share = 1.0
        self._followed_s = 0.0  # when it was within its following error window last
        self._is_behind = False
        self.outgoing.append((0x700 + node, bytes((INITIALISING,))))

    @property
    def position(self) -> int:
        """Position actual value, 32 bits."""
        return _signed32(self._read_shaft() - self._origin)

    def value(self, at: int, sub: int = 0) -> int:
        """The value of an object."""
        match at:
            case 0x6041:
                return self._statusword()
            case 0x6064:
                return self.position
            case 0x606C:
                return round(self._speed)
            case 0x6077:
                return self._torque_permille
            case 0x6079:
                return round(self._supply_V * 1e3)
            case 0x2200:
                return round(self._supply_V * 10) if sub else 1
            case 0x60FD:
                negative, positive = self.at_limits
                return negative | positive << 1 | self.is_home << 2
            case 0x603F:
                return self.error
            case 0x6061:
                return self.objects[0x6060, 0][1]
        return self.objects[at, sub][1]

    # ---- frames

    def receive(self, can_id: int, payload: bytes, now_s: float) -> None:
        """Process a frame from the bus."""
        node = self.setup.node
        if can_id == 0x000 and len(payload) == 2 and payload[1] in (0, node):
            self._nmt(payload[0])
        elif can_id == 0x080 and self.nmt_state == OPERATIONAL:
            self._sync()
        elif can_id == 0x600 + node and len(payload) == 8 and self.nmt_state != STOPPED:
            self.outgoing.append((0x580 + node, self._sdo(payload)))
        elif can_id == 0x700 + (self.objects[0x1016, 1][1] >> 16 & 0x7F):
            self._heard_s = now_s
        elif self.nmt_state == OPERATIONAL:
            for pdo in (0, 1):
                if can_id == self.objects[0x1400 + pdo, 1][1]:
                    self._pending[pdo] = payload

    def _nmt(self, command: int) -> None:
        if command in (0x81, 0x82):
            self.power_up()
        else:
            states = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}
            self.nmt_state = states.get(command, self.nmt_state)

    def _sync(self) -> None:
        """Take over what the RPDOs brought, and send the TPDOs that are mapped to SYNC."""
        for pdo in sorted(self._pending, reverse=True):
            self._unpack(pdo, self._pending.pop(pdo))
        for pdo in (0, 1):
            cob = self.objects[0x1800 + pdo, 1][1]
            if not cob & 0x8000_0000 and self.objects[0x1800 + pdo, 2][1] == 1:
                mapped = self._mapped(0x1A00 + pdo)
                data = b"".join(_packed(kind, self.value(at, sub)) for at, sub, kind in mapped)
                self.outgoing.append((cob & 0x7FF, data))

    def _unpack(self, pdo: int, payload: bytes) -> None:
        for at, sub, kind in self._mapped(0x1600 + pdo):
            size = struct.calcsize(_FORMATS[kind])
            (value,) = struct.unpack(_FORMATS[kind], payload[:size])
            payload = payload[size:]
            self._write(at, sub, kind, value)

    def _mapped(self, mapping: int) -> list[tuple[int, int, str]]:
        entries = [self.objects[mapping, sub][1] for sub in range(1, 1 + self.objects[mapping, 0][1])]
        return [(e >> 16, e >> 8 & 0xFF, self.objects[e >> 16, e >> 8 & 0xFF][0]) for e in entries]

    def _sdo(self, payload: bytes) -> bytes:
        command, at, sub, data = struct.unpack("<BHB4s", payload)
        if command & 0xE0 == 0x60:
            return self._segment(command & 0x10)
        if command == 0x40 and (at, sub) == NAME:
            self._segments = (0, self.setup.name)
            return struct.pack("<BHBI", 0x41, at, sub, len(self.setup.name))
        known = self.objects.get((at, sub))
        if command != 0x40 and command & 0xE0 != 0x20:
            code = UNKNOWN_COMMAND
        elif known is None:
            code = NO_SUB if any(index == at for index, _ in self.objects) else NO_OBJECT
        elif command == 0x40:
            packed = _packed(known[0], self.value(at, sub))
            head = 0x43 | (4 - len(packed)) << 2
            return struct.pack("<BHB4s", head, at, sub, packed.ljust(4, b"\0"))
        else:
            code = self._download(command, at, sub, known[0], data)
        if code:
            return struct.pack("<BHBI", 0x80, at, sub, code)
        return struct.pack("<BHBI", 0x60, at, sub, 0)

    def _segment(self, toggle: int) -> bytes:
        """The next seven bytes of what is read."""
        expected, unread = self._segments
        if toggle != expected or not unread:
            return struct.pack("<BHBI", 0x80, 0, 0, TOGGLE)
        piece, unread = unread[:7], unread[7:]
        self._segments = (expected ^ 0x10, unread)
        return bytes((expected | (7 - len(piece)) << 1 | (not unread),)) + piece.ljust(7, b"\0")

    def _download(self, command: int, at: int, sub: int, kind: str, data: bytes) -> int:
        """Write an object; returns an abort code, 0 if it is done."""
        size = 4 - (command >> 2 & 3)
        if at in _READ_ONLY:
            return READ_ONLY
        if size != struct.calcsize(_FORMATS[kind]):
            return LENGTH
        if (at, sub) in SIGNATURES:
            if data != SIGNATURES[at, sub]:
                return NOT_STORED
            kept = (key for key in self.objects if key[0] not in _READ_ONLY and key[0] not in COMMANDED)
            self._stored = {key: self.objects[key] for key in kept} if (at, sub) == STORE else {}
            return 0
        if 0x1400 <= at <= 0x1BFF and self.nmt_state == OPERATIONAL:
            return STATE
        (value,) = struct.unpack(_FORMATS[kind], data[:size])
        if 0x1600 <= at <= 0x1BFF and at & 0x200 and sub and (value >> 16, value >> 8 & 0xFF) not in self.objects:
            return NO_OBJECT
        if 0x1A00 <= at <= 0x1BFF and sub and value >> 16 == 0x2200:
            return NOT_MAPPABLE
        if 0x1800 <= at <= 0x19FF and sub == 1 and not value & NO_REMOTE_REQUESTS:
            return OUT_OF_RANGE
        self._write(at, sub, kind, value)
        return 0

    def _write(self, at: int, sub: int, kind: str, value: int) -> None:
        self.objects[at, sub] = (kind, value)
        if at == 0x6040:
            self._control(value)

    # ---- states

    def _statusword(self) -> int:
        is_homing = self.objects[0x6060, 0][1] == HOMING
        word = self.state.value | (HOMED if is_homing and self._is_homed else 0) | (DID_NOT_FOLLOW if self._is_behind else 0)
        return word | 0x200 | (0x10 if self.state in (MotorState.SWITCHED_ON, MotorState.ENABLED) else 0)

    def _control(self, controlword: int) -> None:
        word = word_of(controlword, self._word_before)
        new = NEXT.get((self.state, word))
        if self.state is MotorState.QUICK_STOP and word is Word.ENABLE_OPERATION and self.objects[0x605A, 0][1] >= 5:
            new = MotorState.ENABLED  # transition 16
        starts_homing = controlword & START_HOMING and not self._word_before & START_HOMING
        if starts_homing and self.state is MotorState.ENABLED and self.objects[0x6060, 0][1] == HOMING:
            self._origin, self._is_homed = self._read_shaft(), True
            self._held = 0
        self._word_before = controlword
        if new is None or (self.state is MotorState.FAULT and self._cause()):
            return
        if self.state is MotorState.FAULT:
            self.error = 0
            self.outgoing.append((0x80 + self.setup.node, bytes(8)))  # no error
        if new in (MotorState.ENABLED, MotorState.QUICK_STOP):
            self._integral_V, self._held = 0.0, self.position
        self.state = new

    def switch_torque(self, is_on: bool, now_s: float) -> None:
        """Another program takes the drive into operation, to hold its position, or out of it."""
        if is_on:
            self.objects[0x6060, 0], self.objects[0x607A, 0] = ("i8", CSP), ("i32", self.position)
        for controlword in (0x06, 0x07, 0x0F) if is_on else (0x00,):
            self._control(controlword)

    def _fault(self, code: int) -> None:
        self.error, self.state = code, MotorState.FAULT_REACTION
        self._held = self.position
        self.outgoing.append((0x80 + self.setup.node, struct.pack("<HB5s", code, 1, bytes(5))))

    def _cause(self) -> int:
        """The error code of a present cause."""
        if self.forced_error:
            return self.forced_error
        return SUPPLY_LOW if self._supply_V < _LOWEST_SUPPLY_V and self.state is MotorState.ENABLED else 0

    def tick(self, now_s: float, current_A: float, supply_V: float) -> None:
        """Run one control period."""
        step_s = 0.001 if self._last_s is None else now_s - self._last_s
        self._last_s, self._supply_V = now_s, supply_V
        rated_Nm = self.setup.rated_torque_Nm
        torque = round(1e3 * current_A * self.setup.torque_constant_Nm_A / rated_Nm)
        self._torque_permille = min(max(torque, -32768), 32767)
        if self.state is MotorState.NOT_READY:
            self.state = MotorState.SWITCH_ON_DISABLED
        elif self.state is MotorState.FAULT_REACTION:
            self.state = MotorState.FAULT
        self._watch_following(now_s)
        if (cause := self._cause()) and self.state not in (MotorState.FAULT, MotorState.FAULT_REACTION):
            self._fault(cause)
        self._watch_host(now_s)
        self._beat(now_s)
        self._drive(step_s)

    def _watch_following(self, now_s: float) -> None:
        """Out of the window about the demand for the time-out: bit 13, and in an EPOS4 a fault (its firmware specification)."""
        window, most_s = self.objects[0x6065, 0][1], 1e-3 * self.objects[0x6066, 0][1]
        is_controlled = self.state is MotorState.ENABLED and self.objects[0x6060, 0][1] == CSP
        error = abs(_signed32(self._aim - self.position))
        if not is_controlled or window == NO_WINDOW or error <= window:
            self._followed_s, self._is_behind = now_s, False
        elif now_s - self._followed_s > most_s:
            self._is_behind = True
            if self.setup.is_epos4:
                self._fault(FOLLOWING_ERROR)

    def _watch_host(self, now_s: float) -> None:
        timeout_s = (self.objects[0x1016, 1][1] & 0xFFFF) * 1e-3
        if timeout_s and self._heard_s is not None and now_s - self._heard_s > timeout_s:
            self._heard_s = None
            if self.state is MotorState.ENABLED and self.objects[0x6007, 0][1] == 3:
                self.state, self._held, self._integral_V = MotorState.QUICK_STOP, self.position, 0.0
            self.outgoing.append((0x80 + self.setup.node, struct.pack("<HB5s", HEARTBEAT_LOST, 0x11, bytes(5))))

    def _beat(self, now_s: float) -> None:
        every_s = self.objects[0x1017, 0][1] * 1e-3
        if every_s and now_s - self._beat_s >= every_s:
            self._beat_s = now_s
            self.outgoing.append((0x700 + self.setup.node, bytes((self.nmt_state,))))

    # ---- control

    def _drive(self, step_s: float) -> None:
        shaft = self._read_shaft()
        rate, self._before = (shaft - self._before) / step_s, shaft
        self._speed += (rate - self._speed) * step_s / (step_s + SPEED_FILTER_S)
        if self.state is not MotorState.ENABLED or self.objects[0x6060, 0][1] != 8:
            self._aim = self._target = self.position
        if self.state is MotorState.ENABLED:
            self.output = self._by_mode(step_s)
        elif self.state is MotorState.QUICK_STOP:
            self.output = self._to_position(self._held, step_s)
        elif self.state is MotorState.FAULT_REACTION and self.objects[0x605E, 0][1]:
            self.output = Output("voltage", 0.0)  # it slows down
        else:
            self.output = OPEN

    def _by_mode(self, step_s: float) -> Output:
        match self.objects[0x6060, 0][1]:
            case 10:
                torque_Nm = self.objects[0x6071, 0][1] * 1e-3 * self.setup.rated_torque_Nm
                limit_A = self.setup.current_limit_A
                current_A = torque_Nm / self.setup.torque_constant_Nm_A
                return Output("current", min(max(current_A, -limit_A), limit_A))
            case 9:
                return self._to_speed(self.objects[0x60FF, 0][1], step_s)
            case 8:
                return self._to_position(self._interpolated(self.objects[0x607A, 0][1], step_s), step_s)
        return self._to_position(self._held, step_s)

    def _interpolated(self, target: int, step_s: float) -> int:
        """From one target to the next within the interpolation time (0x60C2)."""
        _, unit = self.objects.get((0x60C2, 2), ("i8", 0))
        period_s = self.objects.get((0x60C2, 1), ("u8", 0))[1] * 10.0**unit
        if target != self._target:
            self._since, self._target, self._share = self._aim, target, 0.0
        self._share = min(self._share + step_s / period_s, 1.0) if period_s > 0.0 else 1.0
        way = _signed32(target - self._since)
        self._aim = _signed32(self._since + round(self._share * way))
        return self._aim

    def _to_position(self, target: int, step_s: float) -> Output:
        return self._to_speed(POSITION_RATE * _signed32(target - self.position), step_s)

    def _to_speed(self, counts_s: float, step_s: float) -> Output:
        volts_per_count_s = self.setup.torque_constant_Nm_A * 6.283185307179586 / self.setup.counts_per_turn
        error_V = volts_per_count_s * (counts_s - self._speed)
        wanted_V = volts_per_count_s * counts_s + self.setup.speed_gain * error_V + self._integral_V
        limited_V = min(max(wanted_V, -self._supply_V), self._supply_V)
        if wanted_V == limited_V:
            self._integral_V += SPEED_INTEGRAL * error_V * step_s
        return Output("voltage", limited_V)


def _defaults(setup: Cia402Setup) -> dict[tuple[int, int], tuple[str, int]]:
    """The dictionary after power-up: type and value by index and sub-index."""
    objects: dict[tuple[int, int], tuple[str, int]] = {
        (0x1000, 0): ("u32", 0x0002_0192),
        (0x1001, 0): ("u8", 0),
        (0x1010, 0): ("u8", 1),
        STORE: ("u32", 1),
        (0x1011, 0): ("u8", 1),
        RESTORE: ("u32", 1),
        (0x1016, 0): ("u8", 1),
        (0x1016, 1): ("u32", 0),
        (0x1017, 0): ("u16", 0),
        (0x1018, 0): ("u8", 4),
        (0x1018, 1): ("u32", setup.vendor),
        (0x1018, 2): ("u32", setup.product),
        (0x1018, 3): ("u32", 0x0001_0000),
        (0x1018, 4): ("u32", setup.serial_number),
        (0x6007, 0): ("i16", 1),
        (0x603F, 0): ("u16", 0),
        (0x6040, 0): ("u16", 0),
        (0x6041, 0): ("u16", 0),
        (0x605A, 0): ("i16", 2),
        (0x605E, 0): ("i16", setup.fault_reaction),
        (0x6065, 0): ("u32", setup.following_error_window),
        (0x6066, 0): ("u16", setup.following_error_ms),
        (0x60A8, 0): ("u32", setup.position_unit),
        (0x6060, 0): ("i8", 0),
        (0x6061, 0): ("i8", 0),
        (0x6064, 0): ("i32", 0),
        (0x606C, 0): ("i32", 0),
        (0x6071, 0): ("i16", 0),
        (0x6077, 0): ("i16", 0),
        (0x607A, 0): ("i32", 0),
        **(_of_epos4(setup) if setup.is_epos4 else _plain(setup)),
        (0x60FD, 0): ("u32", 0),
        (0x60FF, 0): ("i32", 0),
        (0x6502, 0): ("u32", setup.modes),
    }
    if setup.has_cycle_time:
        objects |= {(0x60C2, 0): ("u8", 2), (0x60C2, 1): ("u8", 1), (0x60C2, 2): ("i8", -3)}
    for pdo in (0, 1):
        for communication, mapping in ((0x1400, 0x1600), (0x1800, 0x1A00)):
            objects[communication + pdo, 0] = ("u8", 2)
            objects[communication + pdo, 1] = ("u32", 0x8000_0000)
            objects[communication + pdo, 2] = ("u8", 255)
            objects[mapping + pdo, 0] = ("u8", 0)
            objects.update({(mapping + pdo, sub): ("u32", 0) for sub in range(1, 9)})
    return objects


def _plain(setup: Cia402Setup) -> dict[tuple[int, int], tuple[str, int]]:
    """Maximum torque, rated current (mA) and torque (mNm), supply (mV), as CiA 402 has them."""
    return {
        (0x6072, 0): ("u16", 10_000),
        (0x6075, 0): ("u32", round(1e3 * setup.rated_current_A)),
        (0x6076, 0): ("u32", round(1e3 * setup.rated_torque_Nm)),
        (0x6079, 0): ("u32", 0),
    }


def _of_epos4(setup: Cia402Setup) -> dict[tuple[int, int], tuple[str, int]]:
    """The same as maxon has it: nominal current and limit (mA), torque constant (uNm/A), rated torque (uNm), supply (0.1 V)."""
    return {
        (0x2200, 0): ("u8", 1),
        (0x2200, 1): ("u16", 0),
        (0x3001, 0): ("u8", 5),
        (0x3001, 1): ("u32", round(1e3 * setup.rated_current_A)),
        (0x3001, 2): ("u32", round(1e3 * setup.current_limit_A)),
        (0x3001, 3): ("u8", 1),
        (0x3001, 4): ("u16", 100),
        (0x3001, 5): ("u32", round(1e6 * setup.torque_constant_Nm_A)),
        (0x6076, 0): ("u32", round(1e6 * setup.rated_torque_Nm)),
    }


def _packed(kind: str, value: int) -> bytes:
    return struct.pack(_FORMATS[kind], value)


def _signed32(value: int) -> int:
    return (value + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000
