"""Line numbers of the keys of a TOML document, which tomllib does not give.

tomllib has parsed the document before, so the syntax is valid. A path is a tuple of
keys and 0-based indices into the parsed document: `("link", 2, "d_m")`.
"""

import re
import tomllib
from collections.abc import Callable
from typing import Final

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
