"""States and transitions of the motor board (docs/motor_board.md), as one table. For the mock only."""

from __future__ import annotations

from enum import Enum


class MotorState(Enum):
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


NEXT: dict[tuple[MotorState, Word], MotorState] = {
    (MotorState.SWITCH_ON_DISABLED, Word.SHUTDOWN): MotorState.READY,
    (MotorState.READY, Word.SWITCH_ON): MotorState.SWITCHED_ON,
    (MotorState.READY, Word.ENABLE_OPERATION): MotorState.SWITCHED_ON,
    (MotorState.READY, Word.DISABLE_VOLTAGE): MotorState.SWITCH_ON_DISABLED,
    (MotorState.READY, Word.QUICK_STOP): MotorState.SWITCH_ON_DISABLED,
    (MotorState.SWITCHED_ON, Word.SHUTDOWN): MotorState.READY,
    (MotorState.SWITCHED_ON, Word.ENABLE_OPERATION): MotorState.ENABLED,
    (MotorState.SWITCHED_ON, Word.DISABLE_VOLTAGE): MotorState.SWITCH_ON_DISABLED,
    (MotorState.SWITCHED_ON, Word.QUICK_STOP): MotorState.SWITCH_ON_DISABLED,
    (MotorState.ENABLED, Word.SHUTDOWN): MotorState.READY,
    (MotorState.ENABLED, Word.SWITCH_ON): MotorState.SWITCHED_ON,
    (MotorState.ENABLED, Word.DISABLE_VOLTAGE): MotorState.SWITCH_ON_DISABLED,
    (MotorState.ENABLED, Word.QUICK_STOP): MotorState.QUICK_STOP,
    (MotorState.QUICK_STOP, Word.DISABLE_VOLTAGE): MotorState.SWITCH_ON_DISABLED,
    (MotorState.FAULT, Word.FAULT_RESET): MotorState.SWITCH_ON_DISABLED,
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
