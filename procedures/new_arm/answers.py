"""What `armwright new` asks, the options that answer it, and the defaults; a bad answer is asked again."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar

from calib.arm_import import SerialArm
from control.errors import ArmError
from control.model.arm import Convention
from control.model.board_kinds import KINDS, bus_conflict
from control.model.rules import LENGTH, NAME
from firmware_iface.serial_link import PortHere, serial_ports
from procedures.on_boards import REFERENCE, serial_lines

T = TypeVar("T")
FEWEST, MOST = 2, 7
# Axes in the stretched pose: z along the arm, y and x across it. Six joints end in a spherical wrist, seven are an iiwa's.
USUAL_AXES = {2: "zy", 3: "zyy", 4: "zyyy", 5: "zyyyz", 6: "zyyzyz", 7: "zyzyzyz"}
USUAL_LENGTHS_m = {
    2: (0.10, 0.30),
    3: (0.10, 0.35, 0.30),
    4: (0.10, 0.30, 0.25, 0.12),
    5: (0.10, 0.30, 0.25, 0.08, 0.06),
    6: (0.12, 0.32, 0.15, 0.15, 0.08, 0.08),
    7: (0.12, 0.20, 0.15, 0.20, 0.12, 0.08, 0.08),
}
SERVO_SHARE, SERVO_kg, SERVO_TUBE_kg_m = 0.35, 0.08, 0.4  # of servo arms: of the usual lengths; masses
COUNTS_PER_REV, COUNTS_PER_JOINT_TURN = 2048, 65536  # of usual encoders on motors and on joints
FIRST_PORT = "/dev/ttyACM"
CAN = "socketcan:can0"


@dataclass(frozen=True, slots=True)
class Shape:
    """Joint axes and lengths: from the base to joint 2 (joint 1 stands in the base), from joint to joint, to the tip."""

    axes: str
    lengths_m: tuple[float, ...]
    joint_kg: float = 0.5  # motor and gear at the far end of a link
    tube_kg_m: float = 1.5  # of length


@dataclass(frozen=True, slots=True)
class ChosenParts:
    """What is bolted to the joints, one value each; no gears: chosen to hold the arm.

    `boards`: kinds, or REFERENCE; `ports`: of their serial lines, in the order of `serial_lines`; `can`: None if none is on it.
    """

    boards: tuple[str, ...]
    gear_ratios: tuple[float, ...] | None
    counts_per_rev: tuple[int, ...]
    has_home_switches: bool
    encoder_on: Literal["motor", "joint"]
    ports: tuple[str, ...]
    can: tuple[str, str] | None


@dataclass(frozen=True, slots=True)
class Answers:
    """All that a first arm.toml is made of, besides its shape."""

    name: str
    convention: Convention
    parts: ChosenParts


def usual_ports(count: int, here: Sequence[PortHere]) -> tuple[str, ...]:
    """So many ports where nothing else is said: names that stay, of the ports `here`, as far as there are."""
    stable = [port.stable for port in here if port.stable]
    numbered = (f"{FIRST_PORT}{number}" for number in range(count))
    return tuple(stable[:count]) if len(stable) >= count else tuple(numbered)


def is_on_can(kind: str) -> bool:
    """Whether a kind, or the reference motor boards, need a CAN bus."""
    return kind == REFERENCE or KINDS[kind].line == "can"


def is_servo(kind: str) -> bool:
    """Whether a kind is a smart servo, with gear and absolute encoder inside."""
    return kind in KINDS and KINDS[kind].is_absolute


def has_own_counts(kind: str) -> bool:
    """Whether a kind sends counts of its own, whatever the encoder."""
    return kind != REFERENCE and KINDS[kind].counts_per_turn > 0


def may_home(kind: str) -> bool:
    """Whether joints on a kind may have a home switch."""
    return kind == REFERENCE or (KINDS[kind].has_switch and not KINDS[kind].is_absolute)


def name_from(text: str) -> str:
    """An arm's name; ArmError if no file can carry it."""
    if not NAME.holds(text):
        raise ArmError(f"name: expected {NAME.expected}, got {text!r}")
    return text


def joints_from(text: str) -> int:
    """How many joints turn."""
    if not text.isdigit() or not FEWEST <= int(text) <= MOST:
        raise ArmError(f"joints: expected a whole number from {FEWEST} to {MOST}, got {text!r}")
    return int(text)


def axes_from(text: str, joints: int) -> str:
    """One letter a joint, x, y or z."""
    letters = text.strip().lower()
    if len(letters) != joints or set(letters) - set("xyz"):
        raise ArmError(f"axes: expected {joints} letters of x, y, z, such as {USUAL_AXES[joints]}, got {text!r}")
    if set(letters) == {"z"}:
        raise ArmError(f"axes: expected one across the arm, x or y, or the tip does not move, got {text!r}")
    return letters


def lengths_from(words: Sequence[str], joints: int) -> tuple[float, ...]:
    """One length a joint, in m, none below 0 and not all 0."""
    lengths = tuple(_number(word, "lengths") for word in words)
    if len(lengths) != joints:
        raise ArmError(f"lengths: expected {joints} lengths in m, got {len(lengths)}")
    for length in lengths:
        if not LENGTH.holds(length):
            raise ArmError(f"lengths: expected {LENGTH.expected}, got {length:g} ({LENGTH.remedy(length)})")
        if length < 0.0:
            raise ArmError(f"lengths: expected none below 0, got {length:g}")
    if not any(lengths[1:]):
        raise ArmError("lengths: expected one above 0 behind joint 2, or the tip does not move")
    return lengths


def gears_from(words: Sequence[str], joints: int) -> tuple[float, ...]:
    """Motor turns per joint turn, one for all or one each."""
    ratios = _for_each([_number(word, "gears") for word in words], joints, "gears")
    if min(ratios) <= 0.0:
        raise ArmError(f"gears: expected motor turns per joint turn above 0, got {min(ratios):g}")
    return ratios


def encoder_on_from(text: str) -> Literal["motor", "joint"]:
    """The side of the gears on which the encoders are."""
    match text.strip():
        case "motor" | "joint" as side:
            return side
    raise ArmError(f"encoders: expected motor or joint, the side of the gears on which they are, got {text!r}")


def counts_from(words: Sequence[str], joints: int) -> tuple[int, ...]:
    """Counts per turn of the encoder after quadrature, one for all or one each."""
    for word in words:
        if not word.isdigit() or int(word) < 1:
            raise ArmError(f"counts: expected whole numbers of 1 or more per turn, got {word!r}")
    return _for_each([int(word) for word in words], joints, "counts")


def boards_from(words: Sequence[str], joints: int) -> tuple[str, ...]:
    """A kind of board each, one for all or one each; ArmError for those that cannot be on one arm."""
    for word in words:
        if word not in (REFERENCE, *KINDS):
            raise ArmError(f"boards: expected kinds of {', '.join((REFERENCE, *KINDS))}, got {word!r}")
    kinds = _for_each(words, joints, "boards")
    conflict = bus_conflict({"" if kind == REFERENCE else kind for kind in kinds})
    if conflict is not None:
        raise ArmError(f"boards: expected {conflict}, got {' '.join(words)}")
    return kinds


def ports_from(words: Sequence[str], boards: Sequence[str]) -> tuple[str, ...]:
    """One serial port a line of these boards."""
    lines = serial_lines(boards)
    if len(words) != len(lines) or len(set(words)) != len(lines):
        what = f"{len(lines)} different serial ports, of {', '.join(lines)}" if lines else "none with these boards"
        raise ArmError(f"ports: expected {what}, got {' '.join(words) or 'none'}")
    return tuple(words)


def can_from(text: str) -> tuple[str, str]:
    """python-can's interface and channel, joined by a colon."""
    interface, colon, channel = text.partition(":")
    if not (interface and colon and channel):
        raise ArmError(f"can: expected INTERFACE:CHANNEL, such as {CAN}, got {text!r}")
    return interface, channel


def yes_from(text: str) -> bool:
    """A yes or a no."""
    word = text.strip().lower()
    if word not in ("y", "yes", "n", "no"):
        raise ArmError(f"expected yes or no, got {text!r}")
    return word.startswith("y")


def _for_each(values: Sequence[T], joints: int, what: str) -> tuple[T, ...]:
    if len(values) not in (1, joints):
        raise ArmError(f"{what}: expected one value for all or {joints} of them, got {len(values)}")
    return tuple(values) * (joints if len(values) == 1 else 1)


def _number(word: str, what: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ArmError(f"{what}: expected numbers, got {word!r}")
    return value


class Asker(Protocol):
    """Somebody who answers a line at a time."""

    def ask(self, question: str, default: str) -> str:
        """The answer; `default` if it is empty."""

    def say(self, text: str) -> None:
        """Tell them something."""


@dataclass(frozen=True, slots=True)
class Given:
    """Answers given as options; None: asked."""

    joints: str | None = None
    axes: str | None = None
    lengths: Sequence[str] | None = None
    gears: Sequence[str] | None = None
    boards: Sequence[str] | None = None
    counts: Sequence[str] | None = None
    ports: Sequence[str] | None = None
    can: str | None = None
    home: str | None = None
    encoders: str | None = None  # not asked: motor


def ask_shape(options: Given, asker: Asker) -> Shape:
    """Joints, axes and lengths. ArmError if an option is wrong."""
    joints = _joints(options, asker)
    axes = _answer(
        options.axes,
        asker,
        "Axis of each joint in the stretched pose: z along the arm, y or x across it",
        USUAL_AXES[joints],
        lambda text: axes_from(text, joints),
    )
    is_of_servos = bool(options.boards) and all(is_servo(kind) for kind in options.boards or ())
    share = SERVO_SHARE if is_of_servos else 1.0
    lengths = _answer(
        _joined(options.lengths),
        asker,
        "Lengths in m: base to joint 2, then joint to joint, last joint to tip",
        " ".join(f"{share * length:.3g}" for length in USUAL_LENGTHS_m[joints]),
        lambda text: lengths_from(_words(text), joints),
    )
    return Shape(axes, lengths, *((SERVO_kg, SERVO_TUBE_kg_m) if is_of_servos else ()))


def ask_parts(options: Given, asker: Asker, joints: int) -> ChosenParts:
    """Boards, gears, encoders and switches, as far as the boards leave them open. ArmError if an option is wrong."""
    kinds = ", ".join((REFERENCE, *KINDS))
    boards = _answer(
        _joined(options.boards),
        asker,
        f"Board of each joint, one kind for all or one each ({kinds}: docs/boards.md)",
        REFERENCE,
        lambda text: boards_from(_words(text), joints),
    )
    gears = _answer(
        _joined(options.gears),
        asker,
        "Motor turns per joint turn, one for all or one each; auto: chosen with the motors to hold the arm",
        "auto",
        lambda text: None if text.strip() == "auto" else gears_from(_words(text), joints),
    )
    side = encoder_on_from(options.encoders or "motor")
    usual = COUNTS_PER_REV if side == "motor" else COUNTS_PER_JOINT_TURN
    counts = _answer_if(
        not all(map(has_own_counts, boards)),
        _joined(options.counts),
        asker,
        f"Encoder counts per {side} turn after quadrature, one for all or one each",
        str(usual),
        lambda text: counts_from(_words(text), joints),
    )
    index = ", and its encoder an index" if REFERENCE in boards else ""
    home = _answer_if(any(map(may_home, boards)), options.home, asker, f"Has every joint a home switch{index}", "yes", yes_from)
    every_count = counts or (usual,) * joints
    return ChosenParts(boards, gears, every_count, bool(home), side, *_ask_lines(options, asker, boards))


def _ask_lines(options: Given, asker: Asker, boards: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, str] | None]:
    """Serial ports and the CAN bus of the boards, as far as they have any."""
    lines = serial_lines(boards)
    ports = _answer_if(
        bool(lines),
        _joined(options.ports),
        asker,
        f"Serial port{'s' * (len(lines) > 1)} of: {', '.join(lines)}",
        " ".join(usual_ports(len(lines), serial_ports())),
        lambda text: ports_from(_words(text), boards),
    )
    can = _answer_if(
        any(map(is_on_can, boards)),
        options.can,
        asker,
        "CAN bus of the motor boards, as python-can's INTERFACE:CHANNEL",
        CAN,
        can_from,
    )
    return ports or (), can


def _joints(options: Given, asker: Asker) -> int:
    """As told, or as many as there are letters or lengths."""
    count = options.joints
    if count is None and options.axes is not None:
        count = str(len(options.axes.strip()))
    if count is None and options.lengths is not None:
        count = str(len(options.lengths))
    question = f"How many joints turn, {FEWEST} to {MOST}"
    return _answer(count, asker, question, "6", joints_from)


def answers_for(serial: SerialArm, name: str, convention: Convention, options: Given, asker: Asker) -> Answers:
    """Everything else about an arm whose axes are known."""
    return Answers(name_from(name), convention, ask_parts(options, asker, len(serial.joints)))


def _answer(value: str | None, asker: Asker, question: str, default: str, read: Callable[[str], T]) -> T:
    """The option's answer, whose error ends the command; else the asked one, whose error is said and asked again."""
    if value is not None:
        return read(value)
    while True:
        try:
            return read(asker.ask(question, default))
        except ArmError as error:
            asker.say(f"  {error}")


def _answer_if(is_open: bool, value: str | None, asker: Asker, question: str, default: str, read: Callable[[str], T]) -> T | None:
    """As `_answer`; None, and not asked, where the boards leave nothing open. ArmError if it is answered all the same."""
    if is_open:
        return _answer(value, asker, question, default, read)
    if value is not None:
        raise ArmError(f'"{question}" does not arise with these boards: omit the option that says {value}')
    return None


def _words(text: str) -> list[str]:
    return text.replace(",", " ").split()


def _joined(words: Sequence[str] | None) -> str | None:
    return None if words is None else " ".join(words)
