"""Converts drawings to ASCII for terminals that show nothing else."""

import sys
from collections.abc import Mapping

from rich.segment import Segment
from textual.color import Color
from textual.filter import LineFilter

_PLAIN_TERMS = ("linux", "ansi", "vt100", "vt102", "vt220", "dumb")  # no braille in their fonts
_BY_DOTS = " .:-+*oO#"  # a braille character by its number of dots
_SIGNS = {
    "−": "-", "·": ".", "●": "o", "■": "#", "◆": "*", "▸": ">", "↻": "~", "→": ">", "←": "<", "°": " ", "±": "+",
    "│": "|", "┃": "|", "─": "-", "━": "-", "╺": "-", "╸": "-", "▁": "_", "▔": "-", "▕": "|", "▏": "|",
    "┤": "+", "├": "+", "└": "+", "┼": "+", "╭": "+", "╮": "+", "╰": "+", "╯": "+", "┌": "+", "┐": "+", "┘": "+",
}  # fmt: skip
_TABLE = str.maketrans(_SIGNS | {chr(0x2800 + cell): _BY_DOTS[cell.bit_count()] for cell in range(256)})


def ascii_of(text: str) -> str:
    """The text with an ASCII substitute for each other character."""
    return text.translate(_TABLE).encode("ascii", "replace").decode("ascii")


def is_plain(environment: Mapping[str, str]) -> bool:
    """Whether the terminal shows only ASCII, by its encoding or its type."""
    encoding = getattr(sys.__stderr__, "encoding", None) or "ascii"  # Textual draws on stderr
    is_utf = encoding.lower().replace("-", "").startswith("utf")
    return not is_utf or environment.get("TERM", "") in _PLAIN_TERMS


class AsciiFilter(LineFilter):
    """Converts every drawn line to ASCII."""

    def apply(self, segments: list[Segment], background: Color) -> list[Segment]:
        """Convert the segments, keeping their lengths."""
        return [Segment(ascii_of(text), style, control) for text, style, control in segments]
