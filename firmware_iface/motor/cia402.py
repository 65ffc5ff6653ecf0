"""Drive states and transitions of CiA 402 (IEC 61800-7-201), as in docs/motor_board.md.

This table is the host's; the mock boards have their own.
"""

from collections import deque
from enum import Enum, IntEnum
from types import MappingProxyType


class DriveState(Enum):
    """Drive states by their CiA 402 names."""

    NOT_READY_TO_SWITCH_ON = "NOT READY TO SWITCH ON"
    SWITCH_ON_DISABLED = "SWITCH ON DISABLED"
    READY_TO_SWITCH_ON = "READY TO SWITCH ON"
    SWITCHED_ON = "SWITCHED ON"
    OPERATION_ENABLED = "OPERATION ENABLED"
    QUICK_STOP_ACTIVE = "QUICK STOP ACTIVE"
    FAULT_REACTION_ACTIVE = "FAULT REACTION ACTIVE"
    FAULT = "FAULT"


class DriveCommand(IntEnum):
    """Commands of the controlword (0x6040, low byte). SWITCH_ON is also "disable operation"."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80  # acts on the change of bit 7 from 0 to 1


def _transitions() -> dict[tuple[DriveState, DriveCommand], DriveState]:
    s, c = DriveState, DriveCommand
    # In brackets: the number of the transition in CiA 402.
    return {
        (s.SWITCH_ON_DISABLED, c.SHUTDOWN): s.READY_TO_SWITCH_ON,  # (2)
        (s.READY_TO_SWITCH_ON, c.SWITCH_ON): s.SWITCHED_ON,  # (3)
        (s.READY_TO_SWITCH_ON, c.ENABLE_OPERATION): s.SWITCHED_ON,  # (3), one step a COMMAND
        (s.READY_TO_SWITCH_ON, c.DISABLE_VOLTAGE): s.SWITCH_ON_DISABLED,  # (7)
        (s.READY_TO_SWITCH_ON, c.QUICK_STOP): s.SWITCH_ON_DISABLED,  # (7)
        (s.SWITCHED_ON, c.SHUTDOWN): s.READY_TO_SWITCH_ON,  # (6)
        (s.SWITCHED_ON, c.ENABLE_OPERATION): s.OPERATION_ENABLED,  # (4)
        (s.SWITCHED_ON, c.DISABLE_VOLTAGE): s.SWITCH_ON_DISABLED,  # (10)
        (s.SWITCHED_ON, c.QUICK_STOP): s.SWITCH_ON_DISABLED,  # (10)
        (s.OPERATION_ENABLED, c.SHUTDOWN): s.READY_TO_SWITCH_ON,  # (8)
        (s.OPERATION_ENABLED, c.SWITCH_ON): s.SWITCHED_ON,  # (5)
        (s.OPERATION_ENABLED, c.DISABLE_VOLTAGE): s.SWITCH_ON_DISABLED,  # (9)
        (s.OPERATION_ENABLED, c.QUICK_STOP): s.QUICK_STOP_ACTIVE,  # (11)
        (s.QUICK_STOP_ACTIVE, c.DISABLE_VOLTAGE): s.SWITCH_ON_DISABLED,  # (12)
        (s.FAULT, c.FAULT_RESET): s.SWITCH_ON_DISABLED,  # (15)
    }


TRANSITIONS = MappingProxyType(_transitions())


def after(state: DriveState, command: DriveCommand) -> DriveState:
    """The state after `command`; unchanged if the table has no such transition."""
    return TRANSITIONS.get((state, command), state)


def _state_of_statusword(statusword: int) -> DriveState | None:
    """CiA 402: bits 0-3 and 6, with bit 5 (quick stop) where it matters; None if invalid."""
    match statusword & 0x4F:
        case 0x00:
            return DriveState.NOT_READY_TO_SWITCH_ON
        case 0x40:
            return DriveState.SWITCH_ON_DISABLED
        case 0x0F:
            return DriveState.FAULT_REACTION_ACTIVE
        case 0x08:
            return DriveState.FAULT
    return {
        0x21: DriveState.READY_TO_SWITCH_ON,
        0x23: DriveState.SWITCHED_ON,
        0x27: DriveState.OPERATION_ENABLED,
        0x07: DriveState.QUICK_STOP_ACTIVE,
    }.get(statusword & 0x6F)


# By statusword (0x6041, low byte), all 256 values, because it is read every cycle.
STATE_OF_STATUSWORD: tuple[DriveState | None, ...] = tuple(map(_state_of_statusword, range(256)))


def next_command(state: DriveState, wanted: DriveState) -> DriveCommand | None:
    """The first command of the shortest path from `state` to `wanted`.

    None if there is no path. No path leads through OPERATION ENABLED or acknowledges a fault:
    that must be requested explicitly.
    """
    ways: deque[tuple[DriveState, DriveCommand | None]] = deque([(state, None)])
    seen = {state}
    while ways:
        at, first = ways.popleft()
        if at is wanted:
            return first
        if at is DriveState.OPERATION_ENABLED and at is not state:
            continue
        for (origin, command), target in TRANSITIONS.items():
            if origin is at and target not in seen and command is not DriveCommand.FAULT_RESET:
                seen.add(target)
                ways.append((target, command if first is None else first))
    return None
