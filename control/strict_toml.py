"""TOML text to a msgspec Struct: an unknown key, a wrong type or a number that is not finite is one error in TOML's terms."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from typing import TypeVar

import msgspec

from control.files import parsed_toml

T = TypeVar("T")
Fault = Callable[[str], Exception]


def converted(text: str, kind: type[T], fault: Fault, **added: object) -> T:
    """The document as a `kind`, with keys `added` that the text must not have; raises `fault(what is wrong)`."""
    try:
        document = parsed_toml(text)
    except tomllib.TOMLDecodeError as error:
        raise fault(f"not valid TOML: {error}") from error
    _check_finite(document, "", fault)
    for key in added:
        if key in document:
            raise fault(f'unknown key "{key}"')
    return table_as({**document, **added}, kind, fault)


def table_as(table: dict[str, object], kind: type[T], fault: Fault, place: str = "") -> T:
    """A table as a `kind`; `place` is its path in the document, for errors."""
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        raise fault(_readable(str(error), place)) from error


def _check_finite(value: object, key: str, fault: Fault) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise fault(f"{key.lstrip('.')} must be finite, got {value}")
    if isinstance(value, dict):
        for name, inner in value.items():
            _check_finite(inner, f"{key}.{name}", fault)
    if isinstance(value, list):
        for i, inner in enumerate(value):
            _check_finite(inner, f"{key}[{i}]", fault)


def _readable(message: str, above: str) -> str:
    """Translate msgspec's `Object contains unknown field `x` - at `$.camera`` to the terms of TOML."""
    what, _, at = message.partition(" - at ")
    what = what.replace("Object contains unknown field", "unknown key").replace("Object missing required field", "missing key")
    what = what.replace("`object | null`", "a table").replace("`object`", "a table")
    place = f"{above}{at.strip('`').removeprefix('$')}".lstrip(".")
    return f"[{place}] {what}" if place else what
