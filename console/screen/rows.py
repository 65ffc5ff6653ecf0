"""Rows of text with a look each: what panels, views and plots are made of, so that tests and eyes can read them.

A look is a name; which colour it has is said in style.tcss alone. No look is the only sign of anything.
"""

import textwrap
from collections.abc import Iterable

Span = tuple[str, str]  # text, look
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
    """A row of spans; a bare string looks plain."""
    return tuple((part, "plain") if isinstance(part, str) else part for part in parts)


def text_of(rows: Iterable[Row]) -> str:
    """The rows without their looks."""
    return "\n".join("".join(text for text, _ in spans) for spans in rows)


def width_of(spans: Row) -> int:
    """How many columns a row takes."""
    return sum(len(text) for text, _ in spans)


def wrapped(text: str, look: str, width: int, sign: str = "") -> list[Row]:
    """A text on as many rows as it takes, `sign` before the first and as much room before the others."""
    lines = textwrap.wrap(text, max(width - len(sign), 8), break_on_hyphens=False) or [""]
    return [row((sign if n == 0 else " " * len(sign), look), (line, look)) for n, line in enumerate(lines)]
