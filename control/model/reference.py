"""Every key of a TOML file as text, from the definitions that its reader obeys: `armwright arm --keys`.

In: the dataclass (`control.model.reader`) or msgspec Struct (`hil_mocks.scenario`) of the file, whose annotations hold what a
key says. Out: its tables, each with its keys.
"""

import dataclasses
import math
import re
import textwrap
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin, get_type_hints

import msgspec

from control.errors import ArmError
from control.model.arm import Arm
from control.model.reader import keys_of
from control.model.rules import Rule
from control.model.tolerances import Spread

REQUIRED = "required"  # as a default
NOT_A_KEY: Final = "set by the reader"  # as an annotation of a Struct's field
WIDTH, WIDTH_OF_VALUES = 125, 30  # of the text and of its second column, in characters
HEAD = """Every key of an arm.toml. `armwright new` writes a file with comments, `armwright arm FILE` checks it.
Of other files: {others}.

SI units and radians; the unit ends the key's name. Values that look like millimetres, degrees or grams are refused;
`as_given = true` overrides what rests on the other values of the file. Unknown keys are errors. A section without required keys
may be absent; a command that needs it says so.

*: required. In brackets: the default. A range without a type is of a number. A name has 1 to 64 characters without / and \\, and
does not begin with . or -. A word has 1 to 32 letters, digits, - and _, and begins with a letter.
"""
# Conditions as the reader words them in an error, and as a range in the table.
RANGES = (
    (re.compile(r"a name of 1 to \d+ characters, .+"), "name"),
    (re.compile(r"a name of 1 to \d+ letters, .+"), "word"),
    (re.compile(r"an angle within four turns, in rad"), "±8 pi"),
    (re.compile(r"a size of at least (\d+) bytes"), r"whole, ≥ \1"),
    (re.compile(r"a positive number"), "> 0"),
    (re.compile(r"a number not below 0"), "≥ 0"),
    (re.compile(r"a whole number of 1 or more"), "whole, ≥ 1"),
    (re.compile(r"a whole number not below 0"), "whole, ≥ 0"),
    (re.compile(r"an? [\w ]+ up to (.+), above 0"), r"> 0, ≤ \1"),
    (re.compile(r"an? [\w ]+ up to (.+)"), r"≤ \1"),
    (re.compile(r"(?:an? )?\w+ within \+-(.+)"), r"±\1"),
    (re.compile(r"an? [\w ]+ from (\S+ to .+)"), r"\1"),
)


@dataclasses.dataclass(frozen=True, slots=True)
class Key:
    """One key: its TOML type and conditions, its default ("" if it may be absent) and what it says."""

    name: str
    kind: str
    default: str
    text: str


@dataclasses.dataclass(frozen=True, slots=True)
class FileSection:
    """One table of the file: its header, what it is, whether it may be absent, its keys."""

    header: str
    about: str
    keys: tuple[Key, ...]


def sections(file: type[Any] = Arm) -> tuple[FileSection, ...]:
    """Every table of a file, an arm.toml if no other is given, in the order in which the classes name them."""
    return tuple(_sections("", file))


def texts_of(kind: type[Any]) -> dict[str, str]:
    """What each key of a table says, for comments in a file that is written."""
    hints = get_type_hints(kind, include_extras=True)
    return {key: _notes(hints[field.name])[0] for key, field in keys_of(kind).items()}


def reference_text(name: str, others: Mapping[str, Callable[[], Sequence[FileSection]]]) -> str:
    """Every section of an arm.toml, only section `name` ("drive.home"), or those of the other file `name`. ArmError."""
    named = {section.header.strip("[]"): section for section in sections()}
    known = [*filter(None, named), *others]
    if name and name not in known:
        near = get_close_matches(name, known, n=1, cutoff=0.5)
        meant = f" (did you mean {near[0]}?)" if near else ""
        raise ArmError(f'--keys: expected one of {", ".join(known)}; got "{name}"{meant}')
    shown = others[name]() if name in others else [named[name]] if name else [*named.values()]
    parts = ["\n".join((s.header or "[top level]", *filter(None, [s.about]), *_rows(s.keys))) + "\n" for s in shown]
    head = HEAD.format(others=", ".join(f"`armwright arm --keys {other}`" for other in others))
    return "\n".join(parts if name else (head, *parts))


def _rows(keys: tuple[Key, ...]) -> Iterator[str]:
    """The keys of a section in three columns: name, value and default, and what it says."""
    names = [f"{'*' if key.default == REQUIRED else ' '}{key.name}" for key in keys]
    defaults = [f" ({key.default})" if key.default not in ("", REQUIRED) else "" for key in keys]
    values = [key.kind + default for key, default in zip(keys, defaults, strict=True)]
    place = max(map(len, names)) + 2
    indent = place + min(max(map(len, values)), WIDTH_OF_VALUES) + 2
    for name, value, key in zip(names, values, keys, strict=True):
        text = textwrap.wrap(key.text, WIDTH - indent)
        begin = name.ljust(place) + value
        if len(begin) >= indent:
            yield begin
            begin = ""
        yield (begin.ljust(indent) + text[0]).rstrip()
        yield from (" " * indent + line for line in text[1:])


def _sections(header: str, kind: type[Any]) -> Iterator[FileSection]:
    hints = get_type_hints(kind, include_extras=True)
    inner: list[FileSection] = []
    keys: list[Key] = []
    for name, field in _fields(kind):
        table, is_list = _table_in(hints[field.name])
        is_value = table is not None and issubclass(table, msgspec.Struct | Spread) and _notes(hints[field.name])[0]  # in braces
        if table is None or is_value:
            keys.append(_key(name, field, hints[field.name]))
            continue
        parent = header.strip("[]")
        path = f"{parent}.{name}" if parent else name
        inner += _sections(f"[[{path}]]" if is_list else f"[{path}]", table)
    yield FileSection(header, (kind.__doc__ or "").strip().replace("\n    ", "\n"), tuple(keys))
    yield from inner


def _fields(kind: type[Any]) -> list[tuple[str, Any]]:
    """The keys of a table with their fields, which have a name and a default."""
    if not issubclass(kind, msgspec.Struct):
        return list(keys_of(kind).items())
    return [(field.encode_name, field) for field in msgspec.structs.fields(kind) if NOT_A_KEY not in get_args(field.type)]


def _table_in(hint: Any) -> tuple[type[Any] | None, bool]:
    """The class that a key's value is read as, if it is a table, and whether it is a list of them."""
    bare = _bare(hint)
    if get_origin(bare) is tuple:
        table, _ = _table_in(get_args(bare)[0])
        return table, table is not None
    if isinstance(bare, type) and (dataclasses.is_dataclass(bare) or issubclass(bare, msgspec.Struct)):
        return bare, False
    return None, False


def _bare(hint: Any) -> Any:
    """A type without its annotations and without None."""
    if get_origin(hint) is Annotated:
        return _bare(get_args(hint)[0])
    if get_origin(hint) in (Union, types.UnionType):
        kinds = [kind for kind in get_args(hint) if kind is not type(None)]
        return _bare(kinds[0]) if len(kinds) == 1 else hint
    return hint


def _notes(hint: Any) -> tuple[str, str]:
    """What a key says, and its default in words ("" if the code's own says it)."""
    if get_origin(hint) is not Annotated:
        return "", ""
    text, default, *_ = [*(note for note in get_args(hint)[1:] if isinstance(note, str)), "", ""]
    return text, default


def _key(name: str, field: Any, hint: Any) -> Key:
    text, default_words = _notes(hint)
    return Key(name, _value(hint), default_words or _default(field), text)


def _value(hint: Any) -> str:
    """The type and the conditions; a condition on a single value names its type, too."""
    rules, kind = _rules(hint), _kind(hint)
    is_single = kind in ("text", "number", "whole number")
    return ", ".join(map(_range, rules) if rules and is_single else [kind, *map(_range, rules)])


def _range(rule: str) -> str:
    """A condition as a range, or in the reader's words where it is none."""
    prefix = "each " if rule.startswith("each ") else ""
    rule = rule.removeprefix(prefix)
    return prefix + next((form.sub(to, rule) for form, to in RANGES if form.fullmatch(rule)), rule)


def _rules(hint: Any) -> list[str]:
    """The conditions on a value, from the innermost."""
    if get_origin(hint) is Annotated:
        kind, *notes = get_args(hint)
        bounds = [_bounds(note) for note in notes if isinstance(note, msgspec.Meta)]
        return [*_rules(kind), *(note.expected for note in notes if isinstance(note, Rule)), *bounds]
    if get_origin(hint) in (Union, types.UnionType):
        return [rule for kind in get_args(hint) for rule in _rules(kind)]
    if get_origin(hint) is tuple:
        return [f"each {rule}" for rule in _rules(get_args(hint)[0])]
    return []


def _bounds(meta: msgspec.Meta) -> str:
    """A condition of msgspec on a number."""
    if meta.ge is not None and meta.le is not None:
        return f"{meta.ge:g} to {meta.le:g}"
    return f"> {meta.gt:g}" if meta.gt is not None else f"≥ {meta.ge:g}"


def _kind(hint: Any) -> str:
    bare = _bare(hint)
    origin = get_origin(bare)
    if origin is Literal:
        return ", ".join(f'"{choice}"' for choice in get_args(bare))
    if origin is tuple:
        inner = get_args(bare)
        of = "texts" if _bare(inner[0]) is str else "numbers"
        return f"list of {of}" if inner[-1] is Ellipsis else f"{len(inner)} {of}"
    if origin in (Mapping, dict):
        return "table"
    names = {str: "text", bool: "boolean", int: "whole number", float: "number"}
    return names[bare] if bare in names else str(bare.__name__).lower()


def _default(field: Any) -> str:
    value = field.default
    if field.default_factory not in (dataclasses.MISSING, msgspec.NODEFAULT):
        value = field.default_factory()
    if value in (dataclasses.MISSING, msgspec.NODEFAULT):
        return REQUIRED
    if value is None or value in ((), {}, "") or (isinstance(value, float) and math.isinf(value)):
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, tuple):
        return "[" + ", ".join(f"{item:g}" for item in value) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)
