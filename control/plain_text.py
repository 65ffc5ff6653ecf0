"""Output on any terminal: tables of aligned columns; symbols missing from its encoding are replaced by ASCII, and file names are
written byte by byte. One error handler for all streams of the program, so that callers of print need not care.
Long tasks tell their progress to an `Advance`.
"""

from __future__ import annotations

import codecs
import itertools
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from typing import Final, TextIO

HANDLER: Final = "armwright"
IN_ASCII: Final = {
    "°": "deg",
    "±": "+-",
    "µ": "u",
    "μ": "u",
    "·": "*",
    "×": "x",
    "−": "-",
    "–": "-",
    "—": "-",
    "…": "...",
    "√": "sqrt ",
    "²": "^2",
    "³": "^3",
    "→": "->",
    "←": "<-",
    "↑": "^",
    "↓": "v",
    "≤": "<=",
    "≥": ">=",
    "≈": "~",
    "σ": "sigma",
    "■": "#",
    "█": "#",
    "▇": "#",
    "▆": "=",
    "▅": "=",
    "▄": "=",
    "▃": "-",
    "▂": "_",
    "▁": "_",
    "─": "-",
    "│": "|",
}
UNBROKEN: Final = "\N{NO-BREAK SPACE}"
ESCAPED_BYTES: Final = range(0xDC80, 0xDD00)  # how Python represents undecodable bytes of file names


def prepare_streams() -> None:
    """Prevent encoding errors on output and decoding errors on input from now on."""
    codecs.register_error(HANDLER, ascii_fallback)
    for stream, errors in ((sys.stdin, "replace"), (sys.stdout, HANDLER), (sys.stderr, HANDLER)):
        _reconfigure(stream, errors)


def ascii_fallback(error: UnicodeError) -> tuple[str | bytes, int]:
    """Error handler for `codecs`: the substitute for a character that cannot be encoded, and the next position."""
    if isinstance(error, UnicodeDecodeError):  # on decoding
        return "\ufffd", error.end
    if not isinstance(error, UnicodeEncodeError):
        raise error
    character, after = error.object[error.start], error.start + 1
    if ord(character) in ESCAPED_BYTES:
        return bytes([ord(character) & 0xFF]), after
    return IN_ASCII.get(character) or character.encode("ascii", "backslashreplace").decode("ascii"), after


def aligned(rows: Iterable[Sequence[str]], left: int = 1, indent: str = "") -> str:
    """Rows of cells as lines of columns, each as wide as its widest cell: the first `left` flush left, the others flush right."""
    cells = list(rows)
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    if left >= len(widths):
        widths[-1:] = [0]  # nothing follows it
    sides = [str.ljust] * left + [str.rjust] * (len(widths) - left)
    return "\n".join(indent + "  ".join(side(cell, w) for cell, w, side in zip(row, widths, sides, strict=True)) for row in cells)


def folded(text: str, stream: TextIO) -> str:
    """Text for `stream`: on a terminal, sentences that are wider than it are broken between words, and tables between columns.

    Command lines, commands in backticks, and rows whose last column is text stay whole.
    """
    if not stream.isatty():
        return text
    width = shutil.get_terminal_size().columns
    lines: list[str] = []
    for length, rows in itertools.groupby(text.split("\n"), key=lambda line: len(line) if "  " in line.strip() else 0):
        if length:
            lines += _in_parts(list(rows), width)
        else:
            lines += itertools.chain.from_iterable(_folded(line, width) for line in rows)
    return "\n".join(lines)


def _folded(line: str, width: int) -> list[str]:
    indent = line[: len(line) - len(line.lstrip(" "))]
    is_under_columns = len(indent) > width // 2  # there is no room for words
    if len(line) <= width or line.strip().startswith("armwright ") or is_under_columns:
        return [line]
    whole = re.sub("`[^`]*`", lambda command: command[0].replace(" ", UNBROKEN), line)
    lines = textwrap.wrap(whole, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return [part.replace(UNBROKEN, " ") for part in lines]


def _in_parts(rows: Sequence[str], width: int) -> list[str]:
    """Rows of one length under a header without figures, as of `aligned`: columns that are too many follow below, beside the
    first one again.
    """
    if len(rows[0]) <= width or any(map(str.isdigit, rows[0])):
        return list(rows)
    starts = [
        x
        for x in range(2, len(rows[0]))
        if all(row[x - 2 : x] == "  " for row in rows)
        and any(row[x] != " " for row in rows)
        and any(row[:x].strip() for row in rows)
    ]
    cut = max((x for x in starts if x - 2 <= width), default=0)
    if len(rows) == 1 or cut <= min(starts, default=0):
        return list(rows)
    below = [row[: starts[0]] + row[cut:] for row in rows]
    return [*(row[:cut].rstrip() for row in rows), "", *(row.rstrip() for row in _in_parts(below, width))]


def listed(names: Sequence[str]) -> str:
    """a, b and c."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def first_of(names: Sequence[str], most: int) -> str:
    """a, b, c; where there are more than `most`, how many: a, b and 3 more."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _reconfigure(stream: TextIO | None, errors: str) -> None:
    reconfigure = getattr(stream, "reconfigure", None)  # a replaced stream may have no `reconfigure`
    if reconfigure is not None:
        reconfigure(errors=errors)


Advance = Callable[[str, float], None]
"""Called with the present step and the share done, 0 to 1."""


def silent(what: str, share: float) -> None:
    """Show no progress."""
