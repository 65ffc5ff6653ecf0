"""An arm.toml with a comment on every key, in the words of `armwright arm --keys`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import tomli_w

from control.model.arm import (
    Arm,
    Board,
    CanBus,
    Drive,
    DrivePid,
    Effect,
    EncoderBoardPort,
    Home,
    Limits,
    Link,
    Rest,
    Tool,
)
from control.model.board_kinds import KINDS
from control.model.reader import keys_of
from control.model.reference import texts_of
from procedures.new_arm.composing import NewArm

VALUE_WIDTH = 38
ON_REFERENCE = {"encoder_board", "encoder_channel", "motor_node", "board_holds"}
ON_BOUGHT = {"board", "board_channel"}
PLACEHOLDERS = "Placeholders where you did not say otherwise: compare every value with your parts."
SECTIONS = {
    "link": "links: DH rows from base to tip, and what each weighs",
    "drive": f"motors, gears, encoders and limits, one per joint. {PLACEHOLDERS}",
    "home": "home switch; `armwright bringup` measures where it changes and where the index is",
    "board": "bought boards (docs/boards.md)",
    "encoder_board": "encoder boards: three channels each, joints in order",
    "can": "bus of the motor boards; node j of the reference boards drives joint j",
    "rest": "a pose to wait in",
    "limits": "limits that the loop enforces; more of them: armwright arm --keys limits",
    "effect": "effects of the model (docs/formats.md#effects)",
}
LATER = """# Not here yet: [table] with its cavities (session, calibrate without a camera), [camera] (verify), [drive.pid] (gains
# from `armwright tune`; until then from the model). What the arm can do: armwright arm FILE. To try: armwright mock --arm FILE
"""


def commented_text(new: NewArm, origin: str) -> str:
    """The arm as a commented arm.toml; `origin` says what it was made from."""
    arm = new.arm
    lines = [f"# Arm {arm.name}, {origin}. SI units, radians; every key: armwright arm --keys."]
    lines += [f"# {_plain(note)}." for note in new.notes]
    lines += _keys(
        arm,
        Arm,
        (
            "name",
            *(key for key in ("as_given", "placeholders") if getattr(arm, key)),
            "gravity_m_s2",
            "dh_convention",
        ),
    )
    lines += _links(arm)
    if arm.tool != Tool():
        lines += ["", "[tool]", *_keys(arm.tool, Tool, ("position_m",))]
    lines += _drives(arm)
    for number, board in enumerate(arm.boards):
        lines += ["", *([f"# {SECTIONS['board']}"] if number == 0 else []), "[[board]]"]
        lines += _keys(board, Board, _keys_of_board(board), with_comments=number == 0)
    lines += _tables("encoder_board", EncoderBoardPort, arm.encoder_boards, ("name", "port", "baud"))
    if arm.can is not None:
        lines += _table("can", arm.can, CanBus, ("interface", "channel", "bitrate"))
    if arm.rest is not None:
        lines += _table("rest", arm.rest, Rest, ("q_rad",))
    limits: tuple[str, ...] = (
        "tip_speed_m_s",
        "floor_z_m",
        "floor_tolerance_m",
        "base_radius_m",
        "payload_limit_kg",
    )
    limits = (*limits, "stale_s") if arm.boards else limits
    lines += _table("limits", arm.limits, Limits, limits)
    lines += _tables("effect", Effect, arm.effects, ("effect", "joint", "parameters"))
    return "\n".join([*lines, "", LATER])


def _links(arm: Arm) -> list[str]:
    lines, joint = ["", f"# {SECTIONS['link']}"], 0
    for number, link in enumerate(arm.links):
        joint += link.joint == "revolute"
        what = f"# joint {joint}" if link.joint == "revolute" else "# fixed"
        lines += ["", f"{'[[link]]':<{VALUE_WIDTH}}  {what}"]
        lines += _keys(link, Link, _keys_of_link(link), with_comments=number == 0)
    return lines


def _keys_of_link(link: Link) -> tuple[str, ...]:
    return tuple(key for key in keys_of(Link) if getattr(link, key) != "")


def _drives(arm: Arm) -> list[str]:
    lines = ["", f"# {SECTIONS['drive']}"]
    for number, drive in enumerate(arm.drives):
        lines += ["", "[[drive]]", *_keys(drive, Drive, _keys_of_drive(drive), with_comments=number == 0)]
        if drive.board:
            lines += ["", "[drive.pid]", *_keys(drive.pid, DrivePid, ("mode",), with_comments=number == 0)]
        if drive.home is not None:
            lines += ["", *([f"# {SECTIONS['home']}"] if number == 0 else []), "[drive.home]"]
            keys = tuple(key for key in keys_of(Home) if key != "switch")
            lines += _keys(drive.home, Home, keys, with_comments=number == 0)
    return lines


def _keys_of_drive(drive: Drive) -> list[str]:
    """Those of its own table that its board leaves open."""
    left_out = {"pid", "home", "limit_switches"} | (ON_REFERENCE if drive.board else ON_BOUGHT)
    left_out |= set() if drive.zero_count else {"zero_count"}
    left_out |= set() if drive.servo else {"servo"}
    left_out |= {"encoder_on"} if drive.servo else set()
    left_out |= set() if drive.motor_counts_per_rev else {"motor_counts_per_rev"}
    left_out |= set() if drive.encoder_ratio != 1.0 else {"encoder_ratio"}
    left_out |= set() if drive.servos > 1 else {"servos"}
    return [key for key in keys_of(Drive) if key not in left_out]


def _keys_of_board(board: Board) -> list[str]:
    """Those that mean something for its kind."""
    kind = KINDS[board.kind]
    where = ["port", "baud"] if kind.line == "serial" else []
    return [
        "name",
        "kind",
        "address",
        *where,
        *(["absolute", "absolute_turns"] if kind.may_be_absolute else []),
    ]


def _tables(name: str, kind: type[Any], items: Sequence[object], keys: tuple[str, ...]) -> list[str]:
    lines = ["", f"# {SECTIONS[name]}"] if items else []
    for number, item in enumerate(items):
        lines += [*([""] if number else []), f"[[{name}]]"]
        lines += _keys(item, kind, keys, with_comments=number == 0)
    return lines


def _table(name: str, item: object, kind: type[Any], keys: tuple[str, ...]) -> list[str]:
    return ["", f"# {SECTIONS[name]}", f"[{name}]", *_keys(item, kind, keys)]


def _keys(item: object, kind: type[Any], keys: Sequence[str], with_comments: bool = True) -> list[str]:
    """A line for each key that has a value."""
    texts, fields = texts_of(kind), keys_of(kind)
    lines = []
    for key in keys:
        value = getattr(item, fields[key].name)
        if value is None or (isinstance(value, float) and math.isinf(value)):
            continue
        line = f"{key} = {_toml(value)}"
        comment = texts[key].partition(";")[0]
        lines.append(f"{line:<{VALUE_WIDTH}}  # {comment}" if with_comments and comment else line)
    return lines


def _toml(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {_toml(one)}' for key, one in value.items())} }}"
    return tomli_w.dumps({"x": value}).removeprefix("x = ").rstrip("\n")


def _plain(text: str) -> str:
    """One line without control characters, fit for a comment."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())
