"""Parses values of a request; errors name the key, the expected and the actual value."""

import math
from typing import Any

from control.errors import ArmError

Message = dict[str, Any]


def number(request: Message, key: str, lower: float, upper: float, default: float | None = None) -> float:
    value = request.get(key, default)
    if not isinstance(value, int | float) or not is_number(value) or not lower <= value <= upper:
        raise ArmError(
            f"request {request['do']!r}: expected {key} to be a number from {lower:g} to {upper:g}, got {value!r}"
        )
    return float(value)


def is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def flag(request: Message, key: str) -> bool:
    """A boolean, False if absent. Other types are refused, so that "no" does not switch anything on."""
    value = request.get(key, False)
    if not isinstance(value, bool):
        raise ArmError(f"request {request['do']!r}: expected {key} to be true or false, got {value!r}")
    return value


def numbers(request: Message, key: str, count: int) -> tuple[float, ...]:
    values = request.get(key)
    if not isinstance(values, list) or len(values) != count or not all(is_number(value) for value in values):
        raise ArmError(
            f"request {request['do']!r}: expected {key} to be {count} finite numbers, got {values!r}"
        )
    return tuple(float(value) for value in values)
