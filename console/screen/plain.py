"""What is drawn, in ASCII: for a terminal that cannot show more."""

import sys
from collections.abc import Mapping

from rich.segment import Segment
from textual.color import Color
from textual.filter import LineFilter

_PLAIN_TERMS = ("linux", "ansi", "vt100", "vt102", "vt220", "dumb")  # no braille in their fonts
_BY_DOTS = " .:-+*oO#"  # a braille character by its number of dots
_SIGNS = {
    "−": "-", "·": ".", "●": "o", "■": "#", "◆": "*", "▸": ">", "→": ">", "←": "<", "°": " ", "±": "+",
    "│": "|", "┃": "|", "─": "-", "━": "-", "╺": "-", "╸": "-", "▁": "_", "▔": "-", "▕": "|", "▏": "|",
    "┤": "+", "├": "+", "└": "+", "┼": "+", "╭": "+", "╮": "+", "╰": "+", "╯": "+", "┌": "+", "┐": "+", "┘": "+",
}  # fmt: skip
_TABLE = str.maketrans(_SIGNS | {chr(0x2800 + cell): _BY_DOTS[cell.bit_count()] for cell in range(256)})


def ascii_of(text: str) -> str:
    """The text with a likeness for each sign that ASCII lacks."""
    return text.translate(_TABLE).encode("ascii", "replace").decode("ascii")


def is_plain(environment: Mapping[str, str]) -> bool:
    """Whether the terminal shows ASCII only: by its encoding, or by its kind."""
    encoding = getattr(sys.__stderr__, "encoding", None) or "ascii"  # Textual draws on stderr
    is_utf = encoding.lower().replace("-", "").startswith("utf")
    return not is_utf or environment.get("TERM", "") in _PLAIN_TERMS


class AsciiFilter(LineFilter):
    """Turns every line that is drawn into ASCII."""

    def apply(self, segments: list[Segment], background: Color) -> list[Segment]:
        """The segments, each as long as before."""
        return [Segment(ascii_of(text), style, control) for text, style, control in segments]
