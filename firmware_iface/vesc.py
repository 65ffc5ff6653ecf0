"""VESCs on a CAN bus, seen from the host. They send their status unasked; commands are not answered.
The frames come first, without I/O; then the driver.

Frames of a VESC on CAN. Source: VESC firmware 6, comm/comm_can.c, datatypes.h and confgenerator.c.

    29-bit id: packet << 8 | controller id; numbers are big endian

    SET_DUTY 0              i32 duty 1e5             STATUS 9      i32 erpm, i16 current 10/A, i16 duty 1e3
    SET_CURRENT 1           i32 current 1e3/A        STATUS_2 14   i32 charge drawn 1e4/Ah, i32 charge returned 1e4/Ah
    SET_POS 4               i32 angle 1e6/deg        STATUS_3 15   i32 energy drawn 1e4/Wh, i32 energy returned 1e4/Wh
    CONF_CURRENT_LIMITS 21  i32, i32 1e3/A           STATUS_4 16   i16 FETs 10/degC, i16 motor 10/degC, i16 input 10/A,
    PING 17                 u8 who asks                            i16 angle 50/deg
    PONG 18 (to who asked)  u8 id, u8 hardware       STATUS_5 27   i32 tachometer, i16 supply 10/V, i16 reserved
    NOTIFY_BOOT 57          after a start            STATUS_6 58   i16 ADC 1, 2, 3 1e3/V, i16 pulse input 1e3

    PROCESS_SHORT_BUFFER 8  u8 who asks, u8 0, a command of the serial protocol of at most 6 bytes; its answer, if as short,
    comes in the same packet to who asked, with u8 id, u8 1 before it. COMM_GET_VALUES_SELECTIVE 50: u32 mask, then the values.
    A longer answer comes to who asked in FILL_RX_BUFFER 5, u8 place (LONG 6, u16 place), bytes; PROCESS_RX_BUFFER 7, u8 id, u8 1,
    u16 length, u16 CRC of all ends it. COMM_GET_APPCONF 17: u32 signature, u8 id, u32 time-out 1e3/s, f32 its brake current A; 20
    bytes, then u8 application

The current of STATUS is positive while the motor drives and negative while it brakes; with the duty's sign it has a direction.
"""

import binascii
import math
import struct
from collections.abc import Callable
from enum import IntEnum
from typing import Final, NamedTuple

from firmware_iface.clock import Clock
from firmware_iface.errors import BoardReset, BoardSilent, ProtocolViolation
from firmware_iface.link import FrameLink
from firmware_iface.node_bus import NodeBus, UnaskedBoard

IDS: Final = range(254)  # 255 is all of them; 254 is the host's
HOST: Final = 254
COUNTS_PER_TURN: Final = 18_000  # the angle of STATUS_4
GET_APPCONF: Final = 17
GET_VALUES_SELECTIVE: Final = 50
_APPCONF: Final = struct.Struct(">B4xBIf20xB")
FAULT_MASK: Final = 1 << 15
_ASK, _ANSWER = 0, 1
_MOST_i32: Final = 2**31 - 1


class Packet(IntEnum):
    """Packets of VESC's CAN protocol."""

    SET_DUTY = 0
    SET_CURRENT = 1
    SET_POS = 4
    FILL_RX_BUFFER = 5
    FILL_RX_BUFFER_LONG = 6
    PROCESS_RX_BUFFER = 7
    PROCESS_SHORT_BUFFER = 8
    STATUS = 9
    STATUS_2 = 14
    STATUS_3 = 15
    STATUS_4 = 16
    PING = 17
    PONG = 18
    CONF_CURRENT_LIMITS = 21
    STATUS_5 = 27
    NOTIFY_BOOT = 57
    STATUS_6 = 58


Frame = tuple[int, bytes]


class VescStatus(NamedTuple):
    """Electrical speed [1/min], current [A] as described above, duty -1 to 1."""

    erpm: int
    current_A: float
    duty: float


class Status4(NamedTuple):
    """Temperatures, input current, and the encoder's angle in COUNTS_PER_TURN."""

    fets_degC: float
    motor_degC: float
    input_A: float
    angle_count: int


class Status5(NamedTuple):
    """Tachometer in its own counts, and supply."""

    tachometer: int
    supply_V: float


def frame_id(packet: int, controller: int) -> int:
    """The 29-bit id of a packet to or from a controller."""
    return packet << 8 | controller


def duty(controller: int, share: float) -> Frame:
    """Drive with a share of the supply, -1 to 1; 0 shorts the windings."""
    return _scaled(Packet.SET_DUTY, controller, share, 1e5)


def current(controller: int, amperes: float) -> Frame:
    """Drive with a current; 0 opens the circuit."""
    return _scaled(Packet.SET_CURRENT, controller, amperes, 1e3)


def position(controller: int, count: int) -> Frame:
    """Turn the shorter way to an angle within one turn, in COUNTS_PER_TURN."""
    return _scaled(Packet.SET_POS, controller, count % COUNTS_PER_TURN * 360.0 / COUNTS_PER_TURN, 1e6)


def current_limits(controller: int, amperes: float) -> Frame:
    """Limit driving and braking currents until the next start; nothing is stored."""
    most = min(round(amperes * 1e3), _MOST_i32)
    return frame_id(Packet.CONF_CURRENT_LIMITS, controller), struct.pack(">ii", -most, most)


def ping(controller: int) -> Frame:
    """Ask whether a controller is there."""
    return frame_id(Packet.PING, controller), bytes((HOST,))


def ask_fault(controller: int) -> Frame:
    """Ask for the fault code."""
    payload = struct.pack(">BBBI", HOST, _ASK, GET_VALUES_SELECTIVE, FAULT_MASK)
    return frame_id(Packet.PROCESS_SHORT_BUFFER, controller), payload


def fault_in(payload: bytes) -> tuple[int, int] | None:
    """Controller and fault code of an answer to `ask_fault`; None if it is another answer."""
    if len(payload) != 8:
        return None
    controller, kind, command, mask, fault = struct.unpack(">BBBIB", payload)
    if (kind, command, mask) != (_ANSWER, GET_VALUES_SELECTIVE, FAULT_MASK):
        return None
    return controller, fault


class Settings(NamedTuple):
    """What is stored in a controller: its time-out, the brake current after it, and the application that may command it, too."""

    timeout_s: float
    brake_A: float
    application: int


def ask_settings(controller: int) -> Frame:
    """Ask for the application's configuration; a long answer."""
    return frame_id(Packet.PROCESS_SHORT_BUFFER, controller), bytes((HOST, _ASK, GET_APPCONF))


def settings_in(answer: bytes, controller: int) -> Settings | None:
    """What a long answer says of a controller; None if it is another answer, or of another layout."""
    if len(answer) < _APPCONF.size:
        return None
    command, number, timeout_ms, brake_A, application = _APPCONF.unpack_from(answer)
    is_it = (command, number) == (GET_APPCONF, controller)
    return Settings(timeout_ms * 1e-3, brake_A, application) if is_it else None


def status(payload: bytes) -> VescStatus:
    """STATUS. struct.error if it has another length."""
    erpm, current_, duty_ = struct.unpack(">ihh", payload)
    return VescStatus(erpm, current_ / 10, duty_ / 1000)


def counters(payload: bytes) -> tuple[int, int]:
    """STATUS_2 or STATUS_3: what was drawn and returned since the start, in 1e-4 Ah or Wh. struct.error."""
    drawn, returned = struct.unpack(">ii", payload)
    return drawn, returned


def status_4(payload: bytes) -> Status4:
    """STATUS_4. struct.error if it has another length."""
    fets, motor, input_, angle = struct.unpack(">hhhh", payload)
    return Status4(fets / 10, motor / 10, input_ / 10, angle)


def status_5(payload: bytes) -> Status5:
    """STATUS_5, with or without its reserved bytes. struct.error if it has another length."""
    tachometer, supply = struct.unpack(">ih", payload[:6])
    return Status5(tachometer, supply / 10)


def adc_1_V(payload: bytes) -> float:
    """The first analog input in STATUS_6. struct.error if it has another length."""
    volts: int = struct.unpack(">hhhh", payload)[0]
    return volts / 1000


def _scaled(packet: Packet, controller: int, value: float, scale: float) -> Frame:
    return frame_id(packet, controller), struct.pack(">i", round(value * scale))


ANSWER_TIMEOUT_s = 0.05
ATTEMPTS = 3
SETTINGS_WAIT_s = 0.1  # half a thousand bytes, six or seven in a frame
STATUS_WAIT_s = 0.5  # a VESC that sends its status more slowly cannot be used
SWITCH_V: Final = 1.65  # half of the 3.3 V to which the analog input is pulled
UNSEEN_s: Final = 0.1  # longer, and an arm that sinks on shorted windings passes half a turn
UNSEEN_turns: Final = 0.45  # between two angles; beyond half a turn the nearest one is another turn's
SPEED_GAIN: Final = 0.3  # messages arrive a cycle earlier or later than they are sent
LONGEST_ANSWER: Final = 512  # bytes; a VESC's buffer
FILLS: Final[dict[int, int]] = {Packet.FILL_RX_BUFFER: 1, Packet.FILL_RX_BUFFER_LONG: 2}  # bytes of the place
TO_HOST: Final = (Packet.PONG, Packet.PROCESS_SHORT_BUFFER, Packet.PROCESS_RX_BUFFER)
NEEDED: Final = (Packet.STATUS, Packet.STATUS_4, Packet.STATUS_5)


class AngleBatch(NamedTuple):
    """Angles that were read together: the count before them, the time since the ones before [s], how many."""

    count_before: int
    lasted_s: float
    messages: int


class VescBus(NodeBus["Vesc"]):
    """A bus of 29-bit ids with its controllers."""

    def __init__(self, link: FrameLink, clock: Clock) -> None:
        super().__init__(link, clock)
        self._turn = 0
        self._filled = bytearray(LONGEST_ANSWER)

    def _take(self, can_id: int, payload: bytes, now_s: float) -> None:
        packet, number = can_id >> 8, can_id & 0xFF
        if number == HOST and packet in FILLS and payload:
            place, data = int.from_bytes(payload[: FILLS[packet]], "big"), payload[FILLS[packet] :]
            self._filled[place : place + len(data)] = data
            del self._filled[LONGEST_ANSWER:]
            return
        if number == HOST and packet in TO_HOST and payload:
            number = payload[0]
            if packet == Packet.PROCESS_RX_BUFFER and len(payload) == 6:
                length, crc = struct.unpack_from(">HH", payload, 2)
                payload = bytes(self._filled[:length])
                if binascii.crc_hqx(payload, 0) != crc:
                    return
        if (controller := self.nodes.get(number)) is not None:
            controller.take(packet, payload, now_s)

    def flush(self) -> None:
        """Send every controller its command, and ask one of them for its fault code. Raises LinkLost."""
        super().flush()
        numbers = list(self.nodes)
        self._turn = (self._turn + 1) % len(numbers)
        if self.nodes[numbers[self._turn]].tells_faults:
            self.send(ask_fault(numbers[self._turn]))


class Vesc(UnaskedBoard):
    """Keeps the latest values of a controller and its command; times are the host's, on arrival, but for the count's."""

    make, numbers = "VESC", IDS

    def __init__(self, bus: VescBus, number: int, name: str) -> None:
        super().__init__(bus, number, name, NEEDED)
        self.wanted: Frame | None = None
        """The command of the next cycle; None: it goes on with what it does until its own time-out."""
        self.is_driving = False
        """Whether it gave its motor a voltage at its last status."""
        self.is_counted = True
        """Whether anybody uses its count: without, turns that it loses matter to nobody."""
        self.fault: int | None = None
        self.fault_at_s = -math.inf
        self.settings: Settings | None = None
        """What is stored in it; None: its firmware does not say it so."""
        self._last_raw: int | None = None
        self._step = 0  # of the count, between the last two status messages
        self._batch = AngleBatch(0, math.inf, 0)
        self._speed_count_s = 0.0
        self._counters: dict[int, tuple[int, int]] = {}
        self._is_here = False
        self.tells_faults = True
        """Whether it answers the question for its fault code; without, only what a fault does to the motor is seen."""
        self._bus = bus

    @property
    def is_known(self) -> bool:
        """Whether its fault code has come."""
        return self.fault is not None

    def frames(self) -> tuple[Frame, ...]:
        """The command of this cycle."""
        return () if self.wanted is None else (self.wanted,)

    # ---- outside of the cycle

    def identify(self) -> str:
        """Check that it sends its status. What it does not answer is told, in words. BoardSilent says what is missing."""
        self._is_here, self.tells_faults = False, True
        asked: tuple[tuple[Frame, Callable[[], bool], float, str], ...] = (
            (ping(self.number), lambda: self._is_here, ANSWER_TIMEOUT_s, "PING"),
            (
                ask_fault(self.number),
                lambda: self.fault is not None,
                ANSWER_TIMEOUT_s,
                "the question for its fault code: a fault shows by its effect alone",
            ),
            (ask_settings(self.number), lambda: self.settings is not None, SETTINGS_WAIT_s, ""),
        )
        self.settings = self.fault = None
        silent = [what for frame, is_answered, wait_s, what in asked if not self._answers(frame, is_answered, wait_s)]
        if self.fault is None:
            self.tells_faults, self.fault = False, 0
        self.await_status()
        return "".join(f"; it does not answer {what}" for what in silent if what)

    def _answers(self, frame: Frame, is_answered: Callable[[], bool], wait_s: float) -> bool:
        for _ in range(ATTEMPTS):
            self._bus.send(frame)
            if self._bus.waits(is_answered, wait_s):
                return True
        return False

    def await_status(self) -> None:
        """Wait for values that are sent from now on, and the fault code. BoardSilent."""
        asked_s = self._bus.clock.now_s()
        if self.tells_faults:
            self._bus.send(ask_fault(self.number))
        if not self._bus.waits(lambda: min(self.at_s, self._told_at_s) > asked_s, STATUS_WAIT_s):
            missing = [packet.name.replace("_", " ") for packet, at_s in self._at_s.items() if at_s <= asked_s]
            missing += ["answer to COMM_GET_VALUES_SELECTIVE"] if self._told_at_s <= asked_s else []
            is_gone = not self._is_here and len(missing) == len(NEEDED)
            remedy = (
                f"check its supply, id {self.number}, CAN mode VESC and bit rate"
                if is_gone
                else "switch on status messages 1, 4 and 5 in VESC Tool (App Settings, General, CAN)"
            )
            raise BoardSilent(f"{self.where}: no {', '.join(missing)} within {STATUS_WAIT_s} s: {remedy}")

    @property
    def _told_at_s(self) -> float:
        return self.fault_at_s if self.tells_faults else math.inf

    def await_count(self) -> None:
        """Wait for a count that is sent from now on: with all other values. BoardSilent."""
        self.await_status()

    def is_well_within(self, limit_s: float) -> bool:
        """Ask for the fault code until there is no fault; False if there still is one then. BoardSilent."""
        clock = self._bus.clock
        end_s = clock.now_s() + limit_s
        self.await_status()
        while self.fault and clock.now_s() < end_s:
            self.await_status()
        return not self.fault

    def limit_current(self, amperes: float) -> None:
        """Limit the motor's current; nothing is stored. Raises LinkLost."""
        self._bus.send(current_limits(self.number, amperes))

    # ---- frames

    def take(self, packet: int, payload: bytes, now_s: float) -> None:
        """Process a frame of this controller."""
        try:
            self._take(packet, payload, now_s)
        except struct.error:
            self._bus.problems.append(
                ProtocolViolation(f"{self.where}: packet {packet} with {len(payload)} bytes: check its firmware")
            )

    def _take(self, packet: int, payload: bytes, now_s: float) -> None:
        match packet:
            case Packet.STATUS:
                _, current_A, duty = status(payload)
                self.current_A, self.is_driving = self._directed(current_A, duty), duty != 0.0
            case Packet.STATUS_4:
                fets_degC, motor_degC, _, raw = status_4(payload)
                self.temperature_degC = max(fets_degC, motor_degC)
                if now_s != self._at_s[Packet.STATUS_4]:
                    self._begin_batch(now_s)
                self._follow(raw)
                self.counted.arrived(self._bus.drained_s, now_s)
            case Packet.STATUS_5:
                self.supply_V = status_5(payload).supply_V
            case Packet.STATUS_6:
                self.is_switch_on = adc_1_V(payload) > SWITCH_V
            case Packet.STATUS_2 | Packet.STATUS_3:
                self._watch_counters(packet, counters(payload))
            case Packet.PONG:
                self._is_here = True
            case Packet.PROCESS_SHORT_BUFFER if (answer := fault_in(payload)) is not None:
                self.fault, self.fault_at_s = answer[1], now_s
            case Packet.PROCESS_RX_BUFFER:
                self.settings = settings_in(payload, self.number) or self.settings
            case Packet.NOTIFY_BOOT:
                self._restarted()
        if packet in self._at_s:
            self._at_s[Packet(packet)] = now_s

    def _directed(self, current_A: float, duty: float) -> float:
        """The current with its direction: a driving one has the duty's; where that rounds to 0, the motor brakes its motion."""
        if duty:
            return math.copysign(1.0, duty) * current_A
        return -math.copysign(abs(current_A), self._step)

    def _begin_batch(self, now_s: float) -> None:
        """Angles that are read together were sent one after the other. Too few of them for the time: turns may be missing."""
        last, self._batch = self._batch, AngleBatch(self.count, now_s - self._at_s[Packet.STATUS_4], 0)
        if self.is_counted and last.messages and math.isfinite(last.lasted_s):
            between_s = last.lasted_s / last.messages
            turned = self._speed_count_s * between_s
            if between_s > UNSEEN_s or turned > UNSEEN_turns * COUNTS_PER_TURN:
                self._lose_turns(between_s)
            speed_count_s = abs(self.count - last.count_before) / last.lasted_s
            self._speed_count_s += SPEED_GAIN * (speed_count_s - self._speed_count_s)

    def _follow(self, raw: int) -> None:
        """Count turns: the angle is within one."""
        self._batch = self._batch._replace(messages=self._batch.messages + 1)
        if self._last_raw is not None:
            half = COUNTS_PER_TURN // 2
            self._step = (raw - self._last_raw + half) % COUNTS_PER_TURN - half
            self.count += self._step
        else:
            self.count = raw
        self._last_raw = raw

    def _watch_counters(self, packet: int, now: tuple[int, int]) -> None:
        """Charge and energy only grow: older firmware shows a restart by them alone."""
        before = self._counters.get(packet, now)
        self._counters[packet] = now
        if any(new < old for new, old in zip(now, before, strict=True)):
            self._restarted()

    def _lose_turns(self, unseen_s: float) -> None:
        self._forget()
        self._bus.problems.append(
            BoardReset(
                f"{self.where}: its angle was not seen for {unseen_s * 1e3:.0f} ms, in which its encoder may have passed half a"
                " turn: its count is lost: check the bus's load and its cable, then home again"
            )
        )

    def _forget(self) -> None:
        """Its count means nothing any more."""
        self.resets += 1
        self._batch, self._speed_count_s = AngleBatch(0, math.inf, 0), 0.0

    def _restarted(self) -> None:
        self._forget()
        self._last_raw = None
        self._counters.clear()
        self._bus.problems.append(BoardReset(f"{self.where}: restarted by itself; its motor is free: check its supply and cable"))
