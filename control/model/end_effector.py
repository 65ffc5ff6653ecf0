"""What an arm.toml says about the end of the arm: tools, gripper, pins. A field's name is its key in the file."""

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from control.model.reader import Rejected, read_table
from control.model.rules import DIRECTION, NODE, NOT_NEGATIVE, PIN, POSITIVE, WORD, ZERO_OR_MORE

Vector3 = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Tool:
    """What is mounted on the last link: its tip in the last frame, and whether that is known or to be identified.

    A file has one `[tool]`, or several `[[tool]]` with a `name` each; the first is the one that is on at the start. `mass_kg` is
    a point mass at `com_m` in the last frame (at the tip if it is not given), beyond the masses of the links.
    """

    position_m: Vector3 = (0.0, 0.0, 0.0)
    known: bool = True
    name: Annotated[str, WORD] = ""
    mass_kg: Annotated[float, NOT_NEGATIVE] = 0.0
    com_m: Vector3 | None = None

    @property
    def centre_m(self) -> Vector3:
        """The centre of its mass in the last frame."""
        return self.position_m if self.com_m is None else self.com_m


NO_TOOL = Tool()


@dataclass(frozen=True, slots=True)
class Gripper:
    """A gripper: one motor on a motor board of its own, which opens and closes the fingers.

    The opening is the distance that the motor moves them, 0 (closed) to `travel_m`. Without an encoder on the motor
    (`encoder_counts_per_rev = 0`) it opens and closes until it is stopped, and no opening is known.
    `current_limit_A` is what the motor bears for ever: the board holds it in every mode, so it limits the force at all times.
    """

    motor_node: Annotated[int, NODE]
    travel_m: Annotated[float, POSITIVE]
    travel_per_turn_m: Annotated[float, POSITIVE]  # of the motor
    torque_constant_Nm_A: Annotated[float, POSITIVE]
    resistance_ohm: Annotated[float, POSITIVE]
    supply_V: Annotated[float, POSITIVE]
    current_limit_A: Annotated[float, POSITIVE]
    speed_limit_m_s: Annotated[float, POSITIVE]
    encoder_counts_per_rev: Annotated[int, ZERO_OR_MORE] = 0
    rotor_inertia_kg_m2: Annotated[float, NOT_NEGATIVE] = 0.0
    motor_direction: Annotated[int, DIRECTION] = 1  # 1: a positive voltage opens
    motor_serial_number: Annotated[int, ZERO_OR_MORE] | None = None
    force_N: Annotated[float, POSITIVE] | None = (
        None  # where no force is asked for; default: half of the limit
    )
    on_fault: Literal["hold", "release"] = "hold"  # the drive, after a fault and when the host is gone

    @property
    def constant_N_A(self) -> float:
        """Force per current without friction, and voltage per speed [V s/m]: 2 pi k_t / travel per turn."""
        return 2.0 * math.pi * self.torque_constant_Nm_A / self.travel_per_turn_m

    @property
    def force_limit_N(self) -> float:
        """The force at the current limit."""
        return self.constant_N_A * self.current_limit_A

    @property
    def usual_force_N(self) -> float:
        """The force where none is asked for."""
        return 0.5 * self.force_limit_N if self.force_N is None else self.force_N


@dataclass(frozen=True, slots=True)
class Digital:
    """A spare pin of a motor board (docs/motor_board.md) by name.

    `safe`: of an output, while the board's drive is not enabled and after a fault; "keep": as it was.
    """

    name: Annotated[str, WORD]
    board: Annotated[int, NODE]
    pin: Annotated[int, PIN]
    direction: Literal["input", "output"]
    safe: Literal["low", "high", "keep"] = "low"


def read_tools(document: dict[str, Any]) -> tuple[dict[str, Any], tuple[Tool, ...]]:
    """Read the `[[tool]]`s of a document: the rest of it, and the tools. There are none if it has one `[tool]`, or nothing."""
    tables = document.get("tool")
    if not isinstance(tables, list) or not tables:
        return document, ()
    tools = tuple(read_table(Tool, table, ("tool", index)) for index, table in enumerate(tables))
    seen: set[str] = set()
    for index, tool in enumerate(tools):
        path = ("tool", index, "name")
        if not tool.name:
            raise Rejected(path, "a name for every [[tool]]", "nothing", "`armwright tool NAME` chooses one")
        if tool.name in seen:
            raise Rejected(path, "a unique name for every [[tool]]", f"{tool.name} a second time")
        seen.add(tool.name)
    return {key: value for key, value in document.items() if key != "tool"}, tools
