"""The questions of `armwright new`: each has an option that answers it and a default; a bad answer is asked again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

from calib.arm_import import SerialArm
from control.errors import ArmError
from control.model.arm import Convention
from control.model.board_kinds import KINDS
from firmware_iface.serial_link import serial_ports
from procedures.new_arm import answers
from procedures.new_arm.answers import Answers, ChosenParts, Shape
from procedures.on_boards import REFERENCE, serial_lines

T = TypeVar("T")


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


def ask_shape(given: Given, asker: Asker) -> Shape:
    """Joints, axes and lengths. ArmError if an option is wrong."""
    joints = _joints(given, asker)
    axes = _answer(
        given.axes,
        asker,
        "Axis of each joint in the stretched pose: z along the arm, y or x across it",
        answers.USUAL_AXES[joints],
        lambda text: answers.axes_from(text, joints),
    )
    is_of_servos = bool(given.boards) and all(answers.is_servo(kind) for kind in given.boards or ())
    share = answers.SERVO_SHARE if is_of_servos else 1.0
    lengths = _answer(
        _joined(given.lengths),
        asker,
        "Lengths in m: base to joint 2, then joint to joint, last joint to tip",
        " ".join(f"{share * length:.3g}" for length in answers.USUAL_LENGTHS_m[joints]),
        lambda text: answers.lengths_from(_words(text), joints),
    )
    return Shape(axes, lengths, *((answers.SERVO_kg, answers.SERVO_TUBE_kg_m) if is_of_servos else ()))


def ask_parts(given: Given, asker: Asker, joints: int) -> ChosenParts:
    """Boards, gears, encoders and switches, as far as the boards leave them open. ArmError if an option is wrong."""
    kinds = ", ".join((REFERENCE, *KINDS))
    boards = _answer(
        _joined(given.boards),
        asker,
        f"Board of each joint, one kind for all or one each ({kinds}: docs/boards.md)",
        REFERENCE,
        lambda text: answers.boards_from(_words(text), joints),
    )
    gears = _answer(
        _joined(given.gears),
        asker,
        "Motor turns per joint turn, one for all or one each; auto: chosen with the motors to hold the arm",
        "auto",
        lambda text: None if text.strip() == "auto" else answers.gears_from(_words(text), joints),
    )
    side = answers.encoder_on_from(given.encoders or "motor")
    usual = answers.COUNTS_PER_REV if side == "motor" else answers.COUNTS_PER_JOINT_TURN
    counts = _answer_if(
        not all(map(answers.has_own_counts, boards)),
        _joined(given.counts),
        asker,
        f"Encoder counts per {side} turn after quadrature, one for all or one each",
        str(usual),
        lambda text: answers.counts_from(_words(text), joints),
    )
    index = ", and its encoder an index" if REFERENCE in boards else ""
    home = _answer_if(
        any(map(answers.may_home, boards)), given.home, asker, f"Has every joint a home switch{index}", "yes", answers.yes_from
    )  # fmt: skip
    every_count = counts or (usual,) * joints
    return ChosenParts(boards, gears, every_count, bool(home), side, *_ask_lines(given, asker, boards))


def _ask_lines(
    given: Given, asker: Asker, boards: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, str] | None]:
    """Serial ports and the CAN bus of the boards, as far as they have any."""
    lines = serial_lines(boards)
    ports = _answer_if(
        bool(lines),
        _joined(given.ports),
        asker,
        f"Serial port{'s' * (len(lines) > 1)} of: {', '.join(lines)}",
        " ".join(answers.usual_ports(len(lines), serial_ports())),
        lambda text: answers.ports_from(_words(text), boards),
    )
    can = _answer_if(
        any(map(answers.is_on_can, boards)),
        given.can,
        asker,
        "CAN bus of the motor boards, as python-can's INTERFACE:CHANNEL",
        answers.CAN,
        answers.can_from,
    )
    return ports or (), can


def _joints(given: Given, asker: Asker) -> int:
    """As told, or as many as there are letters or lengths."""
    count = given.joints
    if count is None and given.axes is not None:
        count = str(len(given.axes.strip()))
    if count is None and given.lengths is not None:
        count = str(len(given.lengths))
    question = f"How many joints turn, {answers.FEWEST} to {answers.MOST}"
    return _answer(count, asker, question, "6", answers.joints_from)


def answers_for(serial: SerialArm, name: str, convention: Convention, given: Given, asker: Asker) -> Answers:
    """Everything else about an arm whose axes are known."""
    return Answers(answers.name_from(name), convention, ask_parts(given, asker, len(serial.joints)))


def _answer(given: str | None, asker: Asker, question: str, default: str, read: Callable[[str], T]) -> T:
    """The option's answer, whose error ends the command; else the asked one, whose error is said and asked again."""
    if given is not None:
        return read(given)
    while True:
        try:
            return read(asker.ask(question, default))
        except ArmError as error:
            asker.say(f"  {error}")


def _answer_if(
    is_open: bool, given: str | None, asker: Asker, question: str, default: str, read: Callable[[str], T]
) -> T | None:
    """As `_answer`; None, and not asked, where the boards leave nothing open. ArmError if it is answered all the same."""
    if is_open:
        return _answer(given, asker, question, default, read)
    if given is not None:
        raise ArmError(f'"{question}" does not arise with these boards: omit the option that says {given}')
    return None


def _words(text: str) -> list[str]:
    return text.replace(",", " ").split()


def _joined(words: Sequence[str] | None) -> str | None:
    return None if words is None else " ".join(words)
