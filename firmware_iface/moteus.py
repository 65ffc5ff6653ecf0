"""moteus controllers on a CAN FD bus, seen from the host. Each command asks for the values; the reply brings them.
The frames come first, without I/O; then the driver.

Frames of a moteus controller on CAN FD. Source: moteus' CAN protocol, register and diagnostic references.

id: reply wanted << 15 | source << 8 | destination; the host is 0, so a reply comes with controller << 8

A frame holds subframes, and NOP (0x50) up to a length that CAN FD has; numbers are little endian.
write 0x00, read 0x10, reply 0x20, each + type << 2 (int8, int16, int32, f32) + number of registers, 0: it follows as varuint;
then the first register as varuint, then the values. 0x30, 0x31: a write or read failed; register and error as varuints.

Text goes to and from its console in 0x40 (to it), 0x41 (from it) and 0x42 (asks for it), each + channel, 1, as varuint, then the
number of bytes as varuint; "conf get NAME" is answered by a line with the value of a setting.

registers: 0x000 mode, 0x001 position in turns, 0x002 turns/s, 0x003 torque Nm, 0x004 Q current A, 0x00C how the position
is referenced (2: to the output), 0x00D supply (int16: 0.1 V), 0x00E degC, 0x00F fault, 0x05E inputs of aux1, 0x070 ms since
the start; commands of position mode: 0x020 turns, 0x021 turns/s, 0x022 Nm, 0x023 kp and 0x024 kd scale, 0x025 most Nm,
0x027 watchdog s, 0x028 and 0x029 limits of speed and acceleration (negative: none, whatever is stored), 0x02B scale of the
integral; 0x101 firmware, 0x120 to 0x122 serial number
"""

import math
import struct
from collections.abc import Callable, Iterator
from enum import IntEnum
from typing import Final, NamedTuple

from firmware_iface.errors import BoardReset, BoardSilent, LinkError, MisuseError, ProtocolViolation, WrongIdentity
from firmware_iface.node_bus import AnswersInTurn, NodeBoard, NodeBus

IDS: Final = range(1, 128)
NOP: Final = 0x50
_LENGTHS: Final = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
_TYPES: Final = (struct.Struct("<b"), struct.Struct("<h"), struct.Struct("<i"), struct.Struct("<f"))
_WANTS_REPLY: Final = 0x8000
_REPLY, _WRITE_ERROR, _READ_ERROR = 0x20, 0x30, 0x31
_TEXT_TO, _TEXT_FROM, _ASK_TEXT = 0x40, 0x41, 0x42
_CONSOLE: Final = 1  # a channel
_TEXT_BYTES: Final = 48  # of an answer

Frame = tuple[int, bytes]


class MoteusMode(IntEnum):
    """Modes that are used here."""

    STOPPED = 0
    FAULT = 1
    POSITION = 10
    TIMEOUT = 11
    BRAKE = 15


class Register(IntEnum):
    """Registers that are read here."""

    MODE = 0x000
    POSITION = 0x001
    Q_CURRENT = 0x004
    HOME_STATE = 0x00C
    VOLTAGE = 0x00D
    TEMPERATURE = 0x00E
    FAULT = 0x00F
    AUX1_INPUTS = 0x05E
    MILLISECONDS = 0x070
    FIRMWARE = 0x101
    SERIAL = 0x120


class Position(NamedTuple):
    """A command of position mode. With `gain` 0 it is one of torque; then the position does not matter."""

    turns: float
    speed_turns_s: float
    torque_Nm: float
    gain: float
    most_Nm: float
    watchdog_s: float


REFERENCED_TO_ROTOR, REFERENCED_TO_OUTPUT = 1, 2  # of HOME_STATE
# int8 mode; f32 position to Q current; int16 voltage; int8 temperature and fault; int8 inputs; int32 milliseconds
QUERY: Final = bytes.fromhex("11 00 1c 04 01 15 0d 12 0e 11 5e 19 70")
# int8 home state; int32 firmware; int32 serial number
IDENTITY_QUERY: Final = bytes.fromhex("11 0c 19 81 02 1b a0 02")
_POSITION: Final = struct.Struct("<6B6f2B3f2Bf")
_MODE: Final = b"\x01\x00"
_NO_LIMIT: Final = -1.0  # of 0x028 and 0x029


def position(controller: int, command: Position) -> Frame:
    """Command position mode, and ask for the values."""
    c = command
    written = _POSITION.pack(
        *_MODE,
        MoteusMode.POSITION,
        0x0C,
        6,
        0x20,
        c.turns,
        c.speed_turns_s,
        c.torque_Nm,
        c.gain,
        c.gain,
        c.most_Nm,
        0x0F,
        0x27,
        c.watchdog_s,
        _NO_LIMIT,
        _NO_LIMIT,
        0x0D,
        0x2B,
        c.gain,
    )
    return _frame(controller, written + QUERY)


def drives(frame: Frame) -> bool:
    """Whether a frame commands position mode."""
    return frame[1].startswith(_MODE + bytes((MoteusMode.POSITION,)))


def torque(torque_Nm: float, most_Nm: float, watchdog_s: float) -> Position:
    """Position mode without its gains."""
    return Position(math.nan, 0.0, torque_Nm, 0.0, most_Nm, watchdog_s)


def brake(controller: int) -> Frame:
    """Short the windings, and ask for the values."""
    return _frame(controller, _MODE + bytes((MoteusMode.BRAKE,)) + QUERY)


def stop(controller: int) -> Frame:
    """Free the motor, end a fault or a time-out, and ask for the values."""
    return _frame(controller, _MODE + bytes((MoteusMode.STOPPED,)) + QUERY)


def ask(controller: int, query: bytes = QUERY) -> Frame:
    """Ask for values; nothing is commanded."""
    return _frame(controller, query)


def say(controller: int, text: bytes) -> Frame:
    """A line to its console; it has no reply. At most 61 bytes."""
    return controller, _padded(bytes((_TEXT_TO, _CONSOLE, len(text))) + text)


def ask_text(controller: int) -> Frame:
    """Ask what its console has said since."""
    return _frame(controller, bytes((_ASK_TEXT, _CONSOLE, _TEXT_BYTES)))


def text_in(payload: bytes) -> bytes | None:
    """What its console said; None if the frame is another. ValueError if it is cut short."""
    if payload[:1] != bytes((_TEXT_FROM,)):
        return None
    channel, at = _varuint(payload, 1)
    length, at = _varuint(payload, at)
    if channel != _CONSOLE or len(payload) < at + length:
        raise ValueError("cut short, or of another channel")
    return payload[at : at + length]


def _frame(controller: int, subframes: bytes) -> Frame:
    return _WANTS_REPLY | controller, _padded(subframes)


def _padded(subframes: bytes) -> bytes:
    length = next(length for length in _LENGTHS if length >= len(subframes))
    return subframes.ljust(length, bytes((NOP,)))


def values(payload: bytes) -> dict[int, float]:
    """The registers of a reply, integers as they are; without those that the firmware does not know.

    ValueError if it is no reply, or tells that something was not written; struct.error if it is cut short.
    """
    return dict(_registers(payload))


def _registers(payload: bytes) -> Iterator[tuple[int, float]]:
    at = 0
    while at < len(payload):
        kind = payload[at]
        at += 1
        if kind == NOP:
            continue
        if kind in (_WRITE_ERROR, _READ_ERROR):
            register, at = _varuint(payload, at)
            _, at = _varuint(payload, at)
            if kind == _WRITE_ERROR:
                raise ValueError(f"register 0x{register:03x} cannot be written")
            continue
        if kind & 0xF0 != _REPLY:
            raise ValueError(f"subframe 0x{kind:02x}")
        count = kind & 3
        if not count:
            count, at = _varuint(payload, at)
        first, at = _varuint(payload, at)
        type_ = _TYPES[kind >> 2 & 3]
        for register in range(first, first + count):
            yield register, type_.unpack_from(payload, at)[0]
            at += type_.size


def _varuint(payload: bytes, at: int) -> tuple[int, int]:
    """A number of 7 bits a byte, least significant first, and where it ends."""
    number = shift = 0
    while at < len(payload):
        byte = payload[at]
        at += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number, at
        shift += 7
    raise ValueError("cut short")


ANSWER_TIMEOUT_s = 0.05
ATTEMPTS = 3
TEXT_ANSWERS = 20  # of its console, until a line is there
SETTLE_s = 0.02  # in which a fault whose cause persists comes back
DRIVEN_FOR = 3  # commands of position mode in a row; replies of commands before them have come
LATER_s, LATER_REPLIES = 0.05, 3  # a start that moves by so much, in so many replies, is another one
_HALF: Final = 1 << 31  # of the counter's range
_IDENTITY: Final = {Register.HOME_STATE, Register.FIRMWARE, *(Register.SERIAL + k for k in range(3))}
OPTIONAL: Final = frozenset((Register.AUX1_INPUTS, Register.MILLISECONDS))  # older firmware does not have them
_NOT_RUNNING: Final = (MoteusMode.STOPPED, MoteusMode.FAULT, MoteusMode.TIMEOUT)


class MoteusBus(NodeBus["Moteus"]):
    """A CAN FD bus with its controllers."""

    def _take(self, can_id: int, payload: bytes, now_s: float) -> None:
        if can_id & 0xFF == 0 and (controller := self.nodes.get(can_id >> 8)) is not None:
            controller.take(payload, now_s)


class Moteus(NodeBoard):
    """Keeps the latest values of a controller and its command; times are the host's, on arrival where nothing else is said."""

    make, numbers = "moteus", IDS

    def __init__(self, bus: MoteusBus, number: int, name: str, counts_per_turn: int) -> None:
        """`counts_per_turn`: the position comes as turns, and is made counts of so many a turn."""
        super().__init__(bus, number, name)
        self.counts_per_turn = counts_per_turn
        self.wanted: Frame = ask(number)
        """The command of the next cycle; at first none, so that nothing changes by connecting."""
        self.mode, self.fault = int(MoteusMode.STOPPED), 0
        self.at_s = -math.inf
        self.counted = AnswersInTurn()
        self._driven_for = 0  # commands in a row that were of position mode
        self._was_obeying = self._is_ousted = False
        self._milliseconds = 0
        self._started_s = math.inf  # of its counter of milliseconds, on the host's clock; not yet known
        self._later = 0  # replies in a row by which it started later than that
        self._identity: dict[int, float] | None = None
        self._unknown: frozenset[int] = frozenset()  # of OPTIONAL
        self._text: bytes | None = None  # the last answer of its console
        self._bus = bus

    @property
    def is_known(self) -> bool:
        """Whether a reply has come."""
        return self.at_s != -math.inf

    @property
    def is_driving(self) -> bool:
        """Whether it was in position mode at its last reply."""
        return self.mode == MoteusMode.POSITION

    @property
    def is_running(self) -> bool:
        """Whether it obeyed commands at its last reply: not stopped, braked by others, in FAULT or past its time-out."""
        return self.mode not in _NOT_RUNNING and not self._is_ousted

    def frames(self) -> tuple[Frame, ...]:
        """The command of this cycle."""
        self._driven_for = self._driven_for + 1 if drives(self.wanted) else 0
        self.counted.asked(self._bus.clock.now_s())
        return (self.wanted,)

    def stop_now(self) -> None:
        """Short the windings before the cycle's end. Raises LinkLost."""
        self.wanted = brake(self.number)
        self._send(self.wanted)

    def _send(self, frame: Frame) -> None:
        """One that asks for the values, too."""
        self.counted.asked(self._bus.clock.now_s())
        self._bus.send(frame)

    # ---- outside of the cycle

    def identify(self, least_state: int = 0) -> str:
        """What it says of itself: firmware and serial number. BoardSilent, MisuseError.

        `least_state`: its home state, for a position that is that of the rotor within a turn, or of the output, since power-up.
        """
        self._identity = None
        self._asks(ask(self.number, IDENTITY_QUERY), lambda: self._identity is not None)
        known: dict[int, float] = self._identity or {}
        state = known.get(Register.HOME_STATE, math.nan)
        if least_state and not state >= least_state:
            of_what = "output" if least_state == REFERENCED_TO_OUTPUT else "rotor"
            raise MisuseError(
                f"{self.where}: `absolute` in arm.toml, but its position is not referenced to the {of_what} (home state"
                f" {state:.0f}, not {least_state}): set up an {of_what} encoder, or remove `absolute`"
            )
        self.await_status(is_asked_only=True)
        words = [int(known.get(Register.SERIAL + k, 0)) & 0xFFFF_FFFF for k in (2, 1, 0)]
        text = f"firmware 0x{int(known.get(Register.FIRMWARE, 0)):06x}, serial number {''.join(f'{word:08x}' for word in words)}"
        lacks = [f"0x{register:03X}" for register in (Register.AUX1_INPUTS, Register.MILLISECONDS) if register in self._unknown]
        return text + (f", without registers {', '.join(lacks)}" if lacks else "")

    def setting(self, name: str) -> float:
        """A setting by its name in tview; NaN, too, if its firmware has none of this name. BoardSilent, WrongIdentity."""
        if all(self._said() for _ in range(TEXT_ANSWERS)):  # to somebody else
            raise WrongIdentity(
                f"{self.where}: expected a console that answers, it goes on talking (telemetry?): `tel stop` in tview"
            )
        self._bus.send(say(self.number, f"conf get {name}\n".encode()))
        answer = b""
        for _ in range(TEXT_ANSWERS):
            answer += self._said()
            if b"\n" in answer:
                break
        try:
            return float(answer)
        except ValueError:
            return math.nan

    def _said(self) -> bytes:
        """What its console has said since it was asked last. BoardSilent."""
        self._text = None
        self._asks(ask_text(self.number), lambda: self._text is not None)
        return self._text or b""

    def await_status(self, is_asked_only: bool = False) -> None:
        """Wait for values that are sent from now on, as the answer to the present command or to none. BoardSilent."""
        asked_s = self._bus.clock.now_s()
        self.counted.asked(asked_s)
        frame = ask(self.number) if is_asked_only else self.wanted
        self._asks(frame, lambda: self.at_s > asked_s)

    def await_count(self) -> None:
        """Wait for a count that is made from now on: with all other values. BoardSilent."""
        self.await_status()

    def reset_fault(self) -> bool:
        """End a fault or time-out; the windings are shorted then. Returns whether it is gone. BoardSilent."""
        self._send(stop(self.number))
        self.wanted = brake(self.number)
        end_s = self._bus.clock.now_s() + SETTLE_s
        self.await_status()
        self._bus.waits(lambda: self._bus.clock.now_s() >= end_s, SETTLE_s)
        self.await_status()
        return self.is_running

    def _asks(self, frame: Frame, is_answered: Callable[[], bool]) -> None:
        for _ in range(ATTEMPTS):
            self._bus.send(frame)
            if self._bus.waits(is_answered, ANSWER_TIMEOUT_s):
                return
        raise BoardSilent(
            f"{self.where}: no reply, asked {ATTEMPTS} times: check its supply, id {self.number}, and that the bus is CAN FD with"
            " 1 Mbit/s and 5 Mbit/s for the data"
        )

    # ---- frames

    def take(self, payload: bytes, now_s: float) -> None:
        """Process a reply of this controller."""
        try:
            if (text := text_in(payload)) is not None:
                self._text = text
                return
            registers = values(payload)
            if Register.MODE not in registers:  # to our question who it is, or to one of another program
                self._identity = registers if not registers or registers.keys() & _IDENTITY else self._identity
                return
            problem = self._measured(registers, now_s)
        except (ValueError, OverflowError, KeyError, struct.error) as error:
            problem = ProtocolViolation(
                f"{self.where}: a reply of {len(payload)} bytes cannot be read ({error}): check its firmware"
            )
        if problem is not None:
            self._bus.problems.append(problem)

    def _measured(self, registers: dict[int, float], now_s: float) -> LinkError | None:
        self.count = round(registers[Register.POSITION] * self.counts_per_turn)
        self.mode, self.fault = int(registers[Register.MODE]), int(registers[Register.FAULT])
        self._look_for_others()
        self.current_A = registers[Register.Q_CURRENT]
        self.supply_V = 0.1 * registers[Register.VOLTAGE]
        self.temperature_degC = registers[Register.TEMPERATURE]
        self._unknown = OPTIONAL - registers.keys()
        self.is_switch_on = bool(int(registers.get(Register.AUX1_INPUTS, 0)) & 1)
        self.at_s = now_s
        self.counted.arrived(now_s)
        if Register.MILLISECONDS in registers and self._has_restarted(int(registers[Register.MILLISECONDS]), now_s):
            self.resets += 1
            self.wanted = brake(self.number)
            return BoardReset(f"{self.where}: restarted by itself; its motor was free: check its supply and cable")
        return None

    def _look_for_others(self) -> None:
        """Driven by each of the last commands, and yet braked: by others. A reply tells the mode before its own command."""
        is_braked = self.mode == MoteusMode.BRAKE
        self._is_ousted = is_braked and (self._was_obeying or (self._is_ousted and self._driven_for > 0))
        self._was_obeying = self.is_driving and self._driven_for >= DRIVEN_FOR

    def _has_restarted(self, milliseconds: int, now_s: float) -> bool:
        """Whether its counter began anew. A single reply may have waited for a host that paused; a few in a row may not."""
        step = (milliseconds - self._milliseconds + _HALF) % (2 * _HALF) - _HALF
        self._milliseconds += step
        started_s = now_s - 1e-3 * self._milliseconds
        self._later = self._later + 1 if started_s > self._started_s + LATER_s else 0
        if 0 < self._later < LATER_REPLIES:
            return False
        self._started_s = started_s
        return self._later > 0
