"""The parameters of the motor board by index: name, range, access, value at power-up (docs/motor_board.md)."""

from __future__ import annotations

from dataclasses import dataclass

_I32 = (-(1 << 31), (1 << 31) - 1)
DONE, UNKNOWN_INDEX, READ_ONLY, OUT_OF_RANGE, NOT_IN_THIS_STATE = 0, 1, 2, 3, 4

POSITION_COUNT, KP, KI, KD, DERIVATIVE_FILTER_US = 4, 16, 17, 18, 19
CURRENT_LIMIT_MA, VOLTAGE_LIMIT_MV, INTEGRAL_LIMIT_MV, SPEED_FEEDFORWARD = 20, 21, 22, 23
WATCHDOG_MS, WATCHDOG_ACTION, DISABLED_OUTPUT = 32, 33, 34
STOP_AFTER_MS, STOP_TIME_MS = 35, 36
DIGITAL_PINS, DIGITAL_OUTPUTS, DIGITAL_SAFE_LEVELS, DIGITAL_SAFE_KEEP = 48, 49, 50, 51


@dataclass(frozen=True, slots=True)
class ParameterRange:
    """One writable parameter."""

    lowest: int
    highest: int
    at_power_up: int


def writable(rating_mA: int, digital_pins: int = 0) -> dict[int, ParameterRange]:
    """All writable parameters; `rating_mA` and `digital_pins` are the board's."""
    pins = ParameterRange(0, (1 << digital_pins) - 1, 0)
    digital = (DIGITAL_OUTPUTS, DIGITAL_SAFE_LEVELS, DIGITAL_SAFE_KEEP) if digital_pins else ()
    return {
        **dict.fromkeys(digital, pins),
        POSITION_COUNT: ParameterRange(*_I32, 0),
        KP: ParameterRange(0, _I32[1], 0),
        KI: ParameterRange(0, _I32[1], 0),
        KD: ParameterRange(0, _I32[1], 0),
        DERIVATIVE_FILTER_US: ParameterRange(0, 1_000_000, 1000),
        CURRENT_LIMIT_MA: ParameterRange(1, min(rating_mA, 21_000), rating_mA),
        VOLTAGE_LIMIT_MV: ParameterRange(0, 60_000, 24_000),
        INTEGRAL_LIMIT_MV: ParameterRange(0, 60_000, 0),
        SPEED_FEEDFORWARD: ParameterRange(0, _I32[1], 0),
        WATCHDOG_MS: ParameterRange(0, 10_000, 200),
        WATCHDOG_ACTION: ParameterRange(0, 2, 1),
        DISABLED_OUTPUT: ParameterRange(0, 1, 1),
        STOP_AFTER_MS: ParameterRange(0, 10_000, 0),
        STOP_TIME_MS: ParameterRange(1, 10_000, 100),
    }


def refusal(rows: dict[int, ParameterRange], index: int, value: int) -> int:
    """DONE if the value is allowed at the index, else UNKNOWN_INDEX, READ_ONLY or OUT_OF_RANGE."""
    if index not in rows:
        is_read_only = index <= 6 or (index == DIGITAL_PINS and DIGITAL_OUTPUTS in rows)
        return READ_ONLY if is_read_only else UNKNOWN_INDEX
    row = rows[index]
    if not row.lowest <= value <= row.highest or (index in (WATCHDOG_MS, STOP_AFTER_MS) and 0 < value < 5):
        return OUT_OF_RANGE
    return DONE
