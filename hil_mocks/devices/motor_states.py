"""States and transitions of the motor board (docs/motor_board.md), as one table. For the mock only."""

from __future__ import annotations

from enum import Enum


class State(Enum):
    """CiA 402 states; the value is the statusword, without warning and voltage-enabled."""

    NOT_READY = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY = 0x21
    SWITCHED_ON = 0x23
    ENABLED = 0x27
    QUICK_STOP = 0x07
    FAULT_REACTION = 0x0F
    FAULT = 0x08


class Word(Enum):
    """Commands of a controlword."""

    SHUTDOWN = 1
    SWITCH_ON = 2
    ENABLE_OPERATION = 3
    DISABLE_VOLTAGE = 4
    QUICK_STOP = 5
    FAULT_RESET = 6
    NOTHING = 7


NEXT: dict[tuple[State, Word], State] = {
    (State.SWITCH_ON_DISABLED, Word.SHUTDOWN): State.READY,
    (State.READY, Word.SWITCH_ON): State.SWITCHED_ON,
    (State.READY, Word.ENABLE_OPERATION): State.SWITCHED_ON,
    (State.READY, Word.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.READY, Word.QUICK_STOP): State.SWITCH_ON_DISABLED,
    (State.SWITCHED_ON, Word.SHUTDOWN): State.READY,
    (State.SWITCHED_ON, Word.ENABLE_OPERATION): State.ENABLED,
    (State.SWITCHED_ON, Word.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.SWITCHED_ON, Word.QUICK_STOP): State.SWITCH_ON_DISABLED,
    (State.ENABLED, Word.SHUTDOWN): State.READY,
    (State.ENABLED, Word.SWITCH_ON): State.SWITCHED_ON,
    (State.ENABLED, Word.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.ENABLED, Word.QUICK_STOP): State.QUICK_STOP,
    (State.QUICK_STOP, Word.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.FAULT, Word.FAULT_RESET): State.SWITCH_ON_DISABLED,
}


def word_of(controlword: int, before: int) -> Word:
    """The command in a controlword; fault reset is an edge of bit 7 against the one `before`."""
    if controlword & 0x80:
        return Word.NOTHING if before & 0x80 else Word.FAULT_RESET
    if not controlword & 0x02:
        return Word.DISABLE_VOLTAGE
    if not controlword & 0x04:
        return Word.QUICK_STOP
    if not controlword & 0x01:
        return Word.SHUTDOWN
    return Word.ENABLE_OPERATION if controlword & 0x08 else Word.SWITCH_ON
