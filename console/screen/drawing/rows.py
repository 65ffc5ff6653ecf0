"""Rows of styled text, of which panels, views and plots are made; tests can read them.

A style is a name; style.tcss gives its colour. Style is never the only indication of anything.
"""

import textwrap
from collections.abc import Iterable

Span = tuple[str, str]  # text, style
Row = tuple[Span, ...]
LOOKS = (
    "plain",
    "strong",
    "muted",
    "accent",
    "chosen",
    "badge",
    "warning",
    "warning-badge",
    "error",
    "error-badge",
)


def row(*parts: Span | str) -> Row:
    """A row of spans; a bare string has the plain style."""
    return tuple((part, "plain") if isinstance(part, str) else part for part in parts)


def text_of(rows: Iterable[Row]) -> str:
    """The rows without their styles."""
    return "\n".join("".join(text for text, _ in spans) for spans in rows)


def width_of(spans: Row) -> int:
    """Width of a row in columns."""
    return sum(len(text) for text, _ in spans)


def wrapped(text: str, look: str, width: int, sign: str = "") -> list[Row]:
    """Wrap a text to rows, with `sign` before the first and the same indent before the others."""
    lines = textwrap.wrap(text, max(width - len(sign), 8), break_on_hyphens=False) or [""]
    return [row((sign if n == 0 else " " * len(sign), look), (line, look)) for n, line in enumerate(lines)]
