"""moteus controllers on a CAN FD bus, seen from the host. Each command asks for the values; the reply brings them."""

import math
import struct
from collections.abc import Callable
from typing import Final

from firmware_iface.errors import BoardReset, BoardSilent, LinkError, MisuseError, ProtocolViolation, WrongIdentity
from firmware_iface.moteus import wire
from firmware_iface.moteus.wire import Frame, MoteusMode, Register
from firmware_iface.node_bus import AnswersInTurn, NodeBoard, NodeBus

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

    make, numbers = "moteus", wire.IDS

    def __init__(self, bus: MoteusBus, number: int, name: str, counts_per_turn: int) -> None:
        """`counts_per_turn`: the position comes as turns, and is made counts of so many a turn."""
        super().__init__(bus, number, name)
        self.counts_per_turn = counts_per_turn
        self.wanted: Frame = wire.ask(number)
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
        self._driven_for = self._driven_for + 1 if wire.drives(self.wanted) else 0
        self.counted.asked(self._bus.clock.now_s())
        return (self.wanted,)

    def stop_now(self) -> None:
        """Short the windings before the cycle's end. Raises LinkLost."""
        self.wanted = wire.brake(self.number)
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
        self._asks(wire.ask(self.number, wire.IDENTITY_QUERY), lambda: self._identity is not None)
        known: dict[int, float] = self._identity or {}
        state = known.get(Register.HOME_STATE, math.nan)
        if least_state and not state >= least_state:
            of_what = "output" if least_state == wire.REFERENCED_TO_OUTPUT else "rotor"
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
        self._bus.send(wire.say(self.number, f"conf get {name}\n".encode()))
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
        self._asks(wire.ask_text(self.number), lambda: self._text is not None)
        return self._text or b""

    def await_status(self, is_asked_only: bool = False) -> None:
        """Wait for values that are sent from now on, as the answer to the present command or to none. BoardSilent."""
        asked_s = self._bus.clock.now_s()
        self.counted.asked(asked_s)
        frame = wire.ask(self.number) if is_asked_only else self.wanted
        self._asks(frame, lambda: self.at_s > asked_s)

    def await_count(self) -> None:
        """Wait for a count that is made from now on: with all other values. BoardSilent."""
        self.await_status()

    def reset_fault(self) -> bool:
        """End a fault or time-out; the windings are shorted then. Returns whether it is gone. BoardSilent."""
        self._send(wire.stop(self.number))
        self.wanted = wire.brake(self.number)
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
            if (text := wire.text_in(payload)) is not None:
                self._text = text
                return
            registers = wire.values(payload)
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
            self.wanted = wire.brake(self.number)
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
