"""Strict conversion of a parsed TOML document to dataclasses: unknown keys and invalid values are refused; the lines of its keys.

The dataclass is the schema: its annotations give types (`Annotated` adds a `Rule`), `metadata={"key": ...}`
another name in the file. The first error raises `Rejected` with its path, a tuple of keys and 0-based indices into the document:
`("link", 2, "d_m")`. `key_lines` finds its line, which tomllib does not give; tomllib has parsed the document before, so the
syntax is valid.
"""

import dataclasses
import functools
import math
import re
import tomllib
import types
from collections.abc import Callable, Mapping
from difflib import get_close_matches
from typing import Annotated, Any, Final, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from control.model.rules import Rule

Path = tuple[str | int, ...]

_SPACE: Final = re.compile(r"[ \t]*")
_SPACE_AND_COMMENTS: Final = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_KEY: Final = re.compile(r'"(?:[^"\\]|\\.)*"|\'[^\']*\'|[A-Za-z0-9_-]+')
_STRING: Final = re.compile(r'"""(?:[^\\]|\\.)*?"{3,5}|\'\'\'.*?\'{3,5}|"(?:[^"\\\n]|\\.)*"|\'[^\'\n]*\'', re.DOTALL)
_BARE_VALUE: Final = re.compile(r"[^,\]}#\r\n]*")


def key_lines(text: str) -> dict[Path, int]:
    """Return the 1-based line of every table, key and array element of a valid TOML document."""
    return _Scanner(text).run()


def nearest_line(lines: dict[Path, int], path: Path) -> int | None:
    """Return the line of a path, or of its innermost parent in the document."""
    for length in range(len(path), 0, -1):
        if path[:length] in lines:
            return lines[path[:length]]
    return None


def _unquoted(key: str) -> str:
    """Return a key as tomllib reads it, escapes and all."""
    return next(iter(tomllib.loads(f"{key} = 0"))) if key[0] in "\"'" else key


class _Scanner:
    """Recursive descent over keys; values are only skipped."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._at = self._counted_to = 0
        self._line = 1  # at `_counted_to`
        self._lines: dict[Path, int] = {}
        self._array_lengths: dict[Path, int] = {}

    def run(self) -> dict[Path, int]:
        table: Path = ()
        self._skip(_SPACE_AND_COMMENTS)
        while self._at < len(self._text):
            if self._text[self._at] == "[":
                table = self._header()
            else:
                self._key_and_value(table)
            self._skip(_SPACE_AND_COMMENTS)
        return self._lines

    def _skip(self, pattern: re.Pattern[str]) -> str:
        match = pattern.match(self._text, self._at)
        if match is None:
            raise ValueError(f"not the TOML that tomllib took, at character {self._at}")
        self._at = match.end()
        return match.group()

    def _note(self, path: Path) -> None:
        self._line += self._text.count("\n", self._counted_to, self._at)
        self._counted_to = self._at
        self._lines.setdefault(path, self._line)

    def _dotted_key(self) -> list[str]:
        parts: list[str] = []
        while True:
            self._skip(_SPACE)
            parts.append(_unquoted(self._skip(_KEY)))
            self._skip(_SPACE)
            if self._text[self._at] != ".":
                return parts
            self._at += 1

    def _header(self) -> Path:
        """`[a.b]` or `[[a.b]]`; a name of an array of tables means its latest element."""
        is_array = self._text.startswith("[[", self._at)
        self._at += 2 if is_array else 1
        path: Path = ()
        for key in self._dotted_key():
            path = self._latest(path)
            path = (*path, key)
            self._note(path)
        if is_array:
            self._array_lengths[path] = self._array_lengths.get(path, 0) + 1
        path = self._latest(path)
        self._note(path)
        self._at += 2 if is_array else 1
        return path

    def _latest(self, path: Path) -> Path:
        length = self._array_lengths.get(path)
        return path if length is None else (*path, length - 1)

    def _key_and_value(self, table: Path) -> None:
        path = table
        self._skip(_SPACE_AND_COMMENTS)
        for key in self._dotted_key():
            path = (*path, key)
            self._note(path)
        self._at += 1  # the equals sign
        self._value(path)

    def _value(self, path: Path) -> None:
        self._skip(_SPACE_AND_COMMENTS)
        opening = self._text[self._at]
        if opening == "{":
            self._list("}", lambda index: self._key_and_value(path))
        elif opening == "[":
            self._list("]", lambda index: self._element((*path, index)))
        elif opening in "\"'":
            self._skip(_STRING)
        else:
            self._skip(_BARE_VALUE)

    def _element(self, path: Path) -> None:
        self._note(path)
        self._value(path)

    def _list(self, closing: str, item: Callable[[int], None]) -> None:
        self._at += 1
        index = 0
        while True:
            self._skip(_SPACE_AND_COMMENTS)
            if self._text[self._at] == closing:
                self._at += 1
                return
            item(index)
            index += 1
            self._skip(_SPACE_AND_COMMENTS)
            if self._text[self._at] == ",":
                self._at += 1


T = TypeVar("T")
_SCALARS = {str: "text", bool: "true or false", int: "a whole number", float: "a finite number"}


class Rejected(Exception):
    """An invalid entry of the document; the caller knows the file and the lines."""

    def __init__(self, path: Path, expected: str, got: str, hint: str = "") -> None:
        self.path = path
        self.expected = expected
        self.got = got
        self.hint = hint
        super().__init__(f"{path}: expected {expected}, got {got}")


def read_table(kind: type[T], table: object, path: Path = ()) -> T:
    """Read a TOML table as the dataclass `kind`."""
    if not isinstance(table, dict):
        raise Rejected(path, "a table", show(table))
    fields = keys_of(kind)
    for key in table:
        if key not in fields:
            raise _unknown(key, tuple(fields), path)
    hints = _hints(kind)  # type: ignore[arg-type]  # to mypy a type is not hashable
    values = {field.name: _value(hints[field.name], table[key], (*path, key)) for key, field in fields.items() if key in table}
    for key, field in fields.items():
        if key not in table and _is_required(field):
            raise Rejected((*path, key), _words(hints[field.name]), "nothing", "the key is missing")
    return kind(**values)


def keys_of(kind: type[Any]) -> dict[str, "dataclasses.Field[Any]"]:
    """Return the allowed keys of a table of this kind; a field with an empty key is not in the file."""
    fields = {field.metadata.get("key", field.name): field for field in dataclasses.fields(kind)}
    fields.pop("", None)
    return fields


def show(value: object) -> str:
    """Format a value for an error message."""
    if isinstance(value, dict):
        return "a table"
    text = repr(value) if not isinstance(value, bool) else str(value).lower()
    return text if len(text) <= 60 else text[:57] + "..."


@functools.cache  # an arm has some twenty tables, and evaluating annotations takes longer than reading them
def _hints(kind: type[Any]) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _is_required(field: "dataclasses.Field[Any]") -> bool:
    return field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING


def _unknown(key: str, known: tuple[str, ...], path: Path) -> Rejected:
    if close := get_close_matches(key, known, n=1):
        expected = f"one of the keys of this table ({len(known)})"
        return Rejected((*path, key), expected, "an unknown key", f"did you mean {close[0]}?")
    return Rejected((*path, key), "one of the keys " + ", ".join(known), "an unknown key")


def _value(hint: Any, value: object, path: Path) -> Any:
    """Return the value converted to its annotation."""
    origin = get_origin(hint)
    if origin is Annotated:
        return _ruled(hint, value, path)
    if origin in (Union, types.UnionType):
        return _union(hint, value, path)
    if origin is Literal:
        return _literal(hint, value, path)
    if origin is tuple:
        return _tuple(hint, value, path)
    if origin is Mapping:
        return _mapping(get_args(hint)[1], value, path)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return read_table(hint, value, path)
    return _scalar(hint, value, path)


def _ruled(hint: Any, value: object, path: Path) -> Any:
    kind, *rules = get_args(hint)
    result = _value(kind, value, path)
    for rule in rules:
        if isinstance(rule, Rule) and not rule.holds(result):
            raise Rejected(path, rule.expected, show(value), rule.remedy(result))
    return result


def _union(hint: Any, value: object, path: Path) -> Any:
    kinds = [kind for kind in get_args(hint) if kind is not type(None)]
    if len(kinds) == 1:
        return _value(kinds[0], value, path)
    if type(value) in kinds:
        return _value(type(value), value, path)
    raise Rejected(path, _words(hint), show(value))


def _literal(hint: Any, value: object, path: Path) -> Any:
    if isinstance(value, str) and value in get_args(hint):
        return value
    raise Rejected(path, " or ".join(f'"{choice}"' for choice in get_args(hint)), show(value))


def _tuple(hint: Any, value: object, path: Path) -> Any:
    kinds = get_args(hint)
    if not isinstance(value, list):
        remedy = "write [[...]] for a list of tables" if dataclasses.is_dataclass(kinds[0]) else ""
        raise Rejected(path, _words(hint), show(value), remedy)
    if kinds[-1] is Ellipsis:
        kinds = (kinds[0],) * len(value)
    if len(value) != len(kinds):
        raise Rejected(path, _words(hint), f"{len(value)} of them")
    return tuple(_value(kind, item, (*path, index)) for index, (kind, item) in enumerate(zip(kinds, value, strict=True)))


def _mapping(kind: Any, value: object, path: Path) -> Any:
    if not isinstance(value, dict):
        raise Rejected(path, "a table", show(value))
    return {key: _value(kind, item, (*path, key)) for key, item in value.items()}


def _scalar(kind: Any, value: object, path: Path) -> Any:
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind or (kind is float and not math.isfinite(value)):  # type: ignore[arg-type]
        raise Rejected(path, _SCALARS[kind], show(value))
    return value


def _words(hint: Any) -> str:
    """Describe an annotation for an error message."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        rules = [rule.expected for rule in inner[1:] if isinstance(rule, Rule)]
        return rules[0] if rules else _words(inner[0])
    if origin in (Union, types.UnionType):
        return " or ".join(_words(kind) for kind in inner if kind is not type(None))
    if origin is Literal:
        return " or ".join(f'"{choice}"' for choice in inner)
    if origin is tuple:
        count = "a list" if inner[-1] is Ellipsis else f"a list of {len(inner)}"
        return f"{count}: {_words(inner[0])} each"
    return _SCALARS.get(hint, "a table")
