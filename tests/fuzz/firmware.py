"""The firmware in C against the mock's own in Python, both written from one document: random conversations.

`python -m tests.fuzz.firmware [CONVERSATIONS] [SEED]`. Frames are right, mutated and random; the time between them, the control
periods, shafts, currents and supplies are random. After each step both must have said the same bytes, put out the same and be
in the same state. A difference is shown with the fewest steps that still make it.
"""

from __future__ import annotations

import random
import struct
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from hil_mocks.devices.encoder_board import EncoderBoardHardware, EncoderBoardMock, EncoderBoardSetup, frame
from hil_mocks.devices.motor_board import MotorBoardMock
from hil_mocks.devices.motor_inputs import MotorBoardHardware, MotorBoardSetup
from hil_mocks.firmware import EncoderBoardFirmware, MotorBoardFirmware
from tests.fuzz.frames import mutated

NODE = 2
MOTOR = MotorBoardSetup(node=NODE, serial_number=0xF0A1B2C3, counts_per_turn=2048, digital_pins=4)
STEPS = 60
VOLTAGE_V = 0.03  # a stop's set-point is a count, rounded: at most one off, with the largest gain 20 mV
_WARNING = 0x80  # at a limit itself a rounding decides
_WORDS = (0x06, 0x07, 0x0F, 0x0F, 0x0F, 0x00, 0x02, 0x80)
# The highest value of each parameter that is worth writing.
_HIGHEST = {
    16: 20_000,
    17: 500_000,
    18: 50_000,
    19: 3000,
    20: 9000,
    21: 24_000,
    22: 5000,
    23: 20_000,
    32: 60,
    33: 3,
    34: 2,
    35: 30,
    36: 60,
    48: 2,
    49: 16,
    50: 16,
    51: 16,
}
_INDICES = (0, 1, 2, 3, 4, 5, 99, *_HIGHEST, *_HIGHEST)
FASTEST = 4000  # counts in the shortest period: 2^24 a second, at which the firmware cuts speeds as the document lets it
_PERIODS_US = (1000, 1000, 1000, 250, 1700, 10_000)  # the firmware cuts longer ones


class Step(NamedTuple):
    """What happens to both boards, and with what."""

    what: str
    value: Any


class Difference(NamedTuple):
    """The steps that lead to it, and what Python and C had at the last one."""

    steps: tuple[Step, ...]
    python: object
    c: object


class MotorTalk:
    """A motor board, and what happens to it."""

    def __init__(self, kind: type[MotorBoardHardware], setup: MotorBoardSetup = MOTOR) -> None:
        self.shaft, self.now_us = 0, 0
        self.current_A, self.supply_V, self.is_limited = 0.0, 24.0, False
        self.board = kind(setup, lambda: self.shaft)
        self.run(1, 0)

    @property
    def now_s(self) -> float:
        """The time of both boards."""
        return self.now_us * 1e-6

    def run(self, ticks: int, step: int, period_us: int = 1000) -> list[tuple[int, bytes]]:
        """Control periods in which the shaft turns by `step` counts each."""
        said = []
        for _ in range(ticks):
            self.shaft += step
            self.now_us += period_us
            said += self.board.tick(self.now_s, self.current_A, self.supply_V, self.is_limited)
        return said

    def command(self, word: int, mode: int, setpoint: int = 0, feedforward_mV: int = 0) -> list[tuple[int, bytes]]:
        """A COMMAND."""
        return self.send(0x100 + NODE, struct.pack("<BBih", word, mode | 5 << 3, setpoint, feedforward_mV))

    def enable(self) -> list[tuple[int, bytes]]:
        """Through all states to OPERATION ENABLED."""
        return [said for word in (0x06, 0x07, 0x0F) for said in self.command(word, 0)]

    def send(self, can_id: int, payload: bytes) -> list[tuple[int, bytes]]:
        """A frame on the bus."""
        return self.board.receive(can_id, payload, self.now_s)

    def write(self, **values: int) -> None:
        """Parameters by index, `p16=1000`."""
        for index, value in values.items():
            ((_, answer),) = self.send(0x200 + NODE, struct.pack("<BBBBi", 1, int(index[1:]), 1, 0, value))
            assert answer[0] == 0

    def play(self, step: Step) -> object:
        """All that the board says at a step, and its state after it."""
        said: list[tuple[int, bytes]] = []
        match step.what:
            case "run":
                said = self.run(*step.value)
            case "frame":
                said = self.send(*step.value)
            case "enable":
                said = self.enable()
            case "wait":
                self.now_us += step.value
            case "leap":
                self.shaft += step.value
            case "reset":
                self.board.power_up()
            case "forced":
                self.board.forced_faults = step.value
            case "outside":
                self.board.pins.outside = step.value
            case sensed:
                setattr(self, sensed, step.value)
        said = [(i, bytes((p[0] & ~_WARNING, *p[1:])) if i == 0x180 + NODE else p) for i, p in said]
        board = self.board
        return (said, board.state, board.faults, board.position_count, round(board.current_limit_A, 6), board.pins.levels)

    def output(self) -> tuple[str, float]:
        """What the bridge does, and the voltage or current, which differ by a rounding."""
        return self.board.output.kind, self.board.output.value


class EncoderTalk:
    """An encoder board, and what happens to it."""

    def __init__(self, board: EncoderBoardHardware) -> None:
        self.board, self.now_us, self.raw = board, 0, [0, 0, 0]

    def play(self, step: Step) -> object:
        """All that the board says at a step, with the times at which it has left, and its counts."""
        board, now_s = self.board, self.now_us * 1e-6
        match step.what:
            case "bytes":
                board.receive(step.value, now_s)
            case "turn":
                period_us, *steps = step.value
                self.raw = [raw + turned for raw, turned in zip(self.raw, steps, strict=True)]
                self.now_us += period_us
                board.tick(self.now_us * 1e-6, list(self.raw), [raw > 100 for raw in self.raw])
            case "lost":
                (board.lost.add if step.value else board.lost.discard)(1)
            case "error":
                board.quadrature_error(step.value, 3)
            case "frozen":
                board.freeze_clock(step.value)
            case _:
                board.power_up(now_s, self.raw)
        said, board.outgoing[:] = board.outgoing[:], []
        return said, [board.count(at) for at in range(3)]

    def output(self) -> tuple[str, float]:
        """An encoder board drives nothing."""
        return "", 0.0


Talk = MotorTalk | EncoderTalk
Pair = Callable[[], tuple[Talk, Talk]]


def motors() -> tuple[Talk, Talk]:
    """Two motor boards: Python and C."""
    return MotorTalk(MotorBoardMock), MotorTalk(MotorBoardFirmware)


def encoders(bits: int, clock_ppm: float) -> Pair:
    """Two encoder boards, powered up when it is called: Python and C."""
    setup = EncoderBoardSetup(0xA1B2C3, (2048, 1000, 2048), bits, 0x0203, clock_ppm=clock_ppm)
    kinds = (EncoderBoardMock, EncoderBoardFirmware)
    return lambda: tuple(EncoderTalk(kind(setup, (100, 7, -50))) for kind in kinds)


def motor_step(chance: random.Random) -> Step:
    """One step of a conversation with a motor board."""
    draw = chance.randrange
    match draw(14):
        case 0 | 1:
            return Step("enable", None)
        case 2 | 3 | 4:
            return Step("run", (draw(1, 40), draw(-30, 31), chance.choice(_PERIODS_US)))
        case 5:
            return Step("wait", draw(5000) if draw(20) else draw(2**32))
        case 6:
            sensed = chance.choice(("current_A", "supply_V", "is_limited"))
            values = {
                "current_A": (0.0, 1.5, -2.5, 8.0, 13.0, -14.0),
                "supply_V": (24.0, 24.0, 12.0, 8.0, 55.0),
                "is_limited": (False, True),
            }
            return Step(sensed, chance.choice(values[sensed]))
        case 7:
            return chance.choice(
                (
                    Step("forced", chance.choice((0, 0, 1, 2, 32))),
                    Step("outside", draw(256)),
                    Step("leap", draw(-FASTEST, FASTEST + 1)),
                    Step("reset", None),
                )
            )
        case kind:
            return Step("frame", _can_frame(chance, kind))


def _can_frame(chance: random.Random, kind: int) -> tuple[int, bytes]:
    draw = chance.randrange
    if kind == 8:
        return chance.choice((0, 0x101, 0x102, 0x202, 0x302, 0x7FF)), chance.randbytes(draw(9))
    if kind == 9:
        return 0x300 + NODE, bytes((7, draw(256), draw(256))).ljust(8, b"\0")
    if kind == 10:
        index = chance.choice(_INDICES)
        value = draw(-1, _HIGHEST.get(index, 2**31 - 1) + 1)
        sent = struct.pack("<BBBBi", chance.choice((1, 1, 1, 0, 2)), index, draw(1, 256), 0, value)
        can_id = 0x200 + NODE
    else:
        word = chance.choice(_WORDS) if draw(8) else draw(256)
        setpoint, feedforward_mV = draw(-3000, 3001), draw(-3000, 3001)
        if not draw(10):
            setpoint, feedforward_mV = draw(-(2**31), 2**31), draw(-(2**15), 2**15)
        sent = struct.pack("<BBih", word, chance.choice((0, 1, 2, 3, 3, 4, 4, 6)) | 5 << 3, setpoint, feedforward_mV)
        can_id = 0x100 + NODE
    return can_id, sent if draw(10) else mutated(sent, chance)[:8]


def encoder_step(chance: random.Random) -> Step:
    """One step of a conversation with an encoder board."""
    draw = chance.randrange
    match draw(12):
        case 0 | 1 | 2 | 3:
            return Step("bytes", _serial_frame(chance))
        case 4:
            return Step("bytes", chance.randbytes(draw(100)))
        case 5 | 6 | 7:
            return Step("turn", (chance.choice(_PERIODS_US), *(draw(-400, 401) for _ in range(3))))
        case 8:
            return Step("turn", (draw(1, 5000), *(draw(-1, 2) for _ in range(3))))
        case 9:
            return Step("turn", (1000, draw(-(2**31), 2**31), 0, 0))
        case 10:
            return chance.choice((Step("lost", bool(draw(2))), Step("error", draw(3))))
        case _:
            return Step("reset", None) if draw(3) else Step("frozen", bool(draw(2)))


def _serial_frame(chance: random.Random) -> bytes:
    draw = chance.randrange
    kind = chance.choice((1, 2, 3, 4, 5, 5, 0, 0x7E, 0x81))
    body = {
        2: chance.choice((0, 249, 250, 1000, 2000, 999_999, 1_000_000, 1_000_001)).to_bytes(4, "little"),
        3: bytes((draw(4),)) + chance.randbytes(4),
        4: bytes((draw(4), draw(4))),
    }.get(kind, b"")
    body += chance.randbytes(draw(60 - len(body))) if not draw(10) else b""
    coded = frame(bytes((kind, draw(1, 4))) + body)
    return coded if draw(8) else mutated(coded, chance)


def difference(pair: Pair, steps: Sequence[Step]) -> Difference | None:
    """The first difference that the steps make; None if there is none."""
    python, c = pair()
    for at, step in enumerate(steps):
        said = python.play(step), c.play(step)
        (kind, value), (c_kind, c_value) = python.output(), c.output()
        is_same = said[0] == said[1] and kind == c_kind and abs(value - c_value) <= VOLTAGE_V
        if not is_same:
            return Difference(tuple(steps[: at + 1]), (said[0], kind, value), (said[1], c_kind, c_value))
    return None


def shortest(pair: Pair, found: Difference) -> Difference:
    """The difference with steps left out, as long as there is one."""
    at = 0
    while at < len(found.steps):
        less = difference(pair, found.steps[:at] + found.steps[at + 1 :])
        found, at = (less, at) if less else (found, at + 1)
    return found


def conversations(count: int, seed: int) -> Difference | None:
    """Hold so many conversations, every second with an encoder board. The first difference, shortest; None if there is none."""
    for number in range(count):
        chance = random.Random(f"{seed} {number}")
        pair: Pair = motors
        if number % 2:
            pair = encoders(chance.choice((8, 16, 31, 32)), chance.choice((0.0, 200.0, -35.0)))
        step = encoder_step if number % 2 else motor_step
        found = difference(pair, [step(chance) for _ in range(STEPS)])
        if found:
            return shortest(pair, found)
    return None


def main(arguments: Sequence[str]) -> int:
    """Print what was found; exit status 1 if the two differ."""
    count = int(arguments[0]) if arguments else 10_000
    seed = int(arguments[1]) if len(arguments) > 1 else 1
    found = conversations(count, seed)
    if found is None:
        sys.stdout.write(f"{count} conversations of {STEPS} steps, seed {seed}: no difference\n")
        return 0
    sys.stdout.write(f"seed {seed}: a difference\n" + "".join(f"  {step}\n" for step in found.steps))
    sys.stdout.write(f"  Python: {found.python}\n  C:      {found.c}\n")
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
