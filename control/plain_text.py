"""Output on any terminal: symbols missing from its encoding are replaced by ASCII, and file names are written byte by byte.

One error handler for all streams of the program, so that callers of print need not care.
"""

import codecs
import sys
from typing import Final, TextIO

HANDLER: Final = "armwright"
IN_ASCII: Final = {
    "°": "deg", "±": "+-", "µ": "u", "μ": "u", "·": "*", "×": "x", "−": "-", "–": "-", "—": "-", "…": "...", "√": "sqrt ",
    "²": "^2", "³": "^3", "→": "->", "←": "<-", "↑": "^", "↓": "v", "≤": "<=", "≥": ">=", "≈": "~", "σ": "sigma", "■": "#",
    "█": "#", "▇": "#", "▆": "=", "▅": "=", "▄": "=", "▃": "-", "▂": "_", "▁": "_", "─": "-", "│": "|",
}  # fmt: skip
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


def _reconfigure(stream: TextIO | None, errors: str) -> None:
    reconfigure = getattr(stream, "reconfigure", None)  # a replaced stream may have no `reconfigure`
    if reconfigure is not None:
        reconfigure(errors=errors)
