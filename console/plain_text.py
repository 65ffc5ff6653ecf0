"""Output on any terminal: symbols that its encoding lacks are written in ASCII, and file names byte by byte.

One error handler for all of the program's streams, so that no print has to think of it.
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
ESCAPED_BYTES: Final = range(0xDC80, 0xDD00)  # how Python carries bytes of a file name that are no text


def prepare_streams() -> None:
    """From here on no output raises for its characters, and no input for its bytes."""
    codecs.register_error(HANDLER, ascii_fallback)
    for stream, errors in ((sys.stdin, "replace"), (sys.stdout, HANDLER), (sys.stderr, HANDLER)):
        _reconfigure(stream, errors)


def ascii_fallback(error: UnicodeError) -> tuple[str | bytes, int]:
    """The substitute for the first character that cannot be encoded, and the position after it: a handler for `codecs`."""
    if isinstance(error, UnicodeDecodeError):  # of a stream that is read as well
        return "\ufffd", error.end
    if not isinstance(error, UnicodeEncodeError):
        raise error
    character, after = error.object[error.start], error.start + 1
    if ord(character) in ESCAPED_BYTES:
        return bytes([ord(character) & 0xFF]), after
    return IN_ASCII.get(character) or character.encode("ascii", "backslashreplace").decode("ascii"), after


def _reconfigure(stream: TextIO | None, errors: str) -> None:
    reconfigure = getattr(
        stream, "reconfigure", None
    )  # a stream that a test or a caller put there may have none
    if reconfigure is not None:
        reconfigure(errors=errors)
