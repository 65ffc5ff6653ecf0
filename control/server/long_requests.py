"""Long requests, read a slice at a time: thousands of knots are a megabyte of text, which at once would cost some cycles.

    outline   one pass over the line finds where the texts of its lists begin and end
    slices    of such a text: as many rows of numbers as SLICE_bytes hold, into an array
    path      of the arrays, checked as far as that needs nothing of the arm's state

Between two steps the loop runs a cycle. A slice takes some 0.3 ms; for 10,000 knots the pass over the line and the making of the
path, one step each, take some 2 ms.
"""

from collections.abc import Generator
from typing import TYPE_CHECKING, Any, Final

import msgspec

from control.errors import ArmError
from control.motion.joint_path import JointPath
from control.motion.plan import PlannedPath
from control.server import messages
from control.server.messages import Asked

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

LONG_bytes: Final = 1 << 14  # of a line that is read in slices
SLICE_bytes: Final = 1 << 14
WORDS_bytes: Final = 1 << 17  # of a list with words in it: what slows two thousand sections
Steps = Generator[None, None, Any]
_OBJECT: Final = msgspec.json.Decoder(dict[str, msgspec.Raw])
_ROWS: Final = msgspec.json.Decoder(list[list[float]])
_NUMBERS: Final = msgspec.json.Decoder(list[float])


def is_long(line: bytes) -> bool:
    """Whether a line is read in slices."""
    return len(line) > LONG_bytes


def steps(request: Asked) -> Steps:
    """Read a request, and return what `messages.decoded` does, its paths made. ArmError at any step."""
    outline = messages.outlined(request)
    yield
    moves = outline.moves.values() if isinstance(outline, messages.MoveTogether) else (outline,)
    for move in moves:
        if isinstance(move.path, dict):
            path: dict[str, Any] = {}
            for name, text in move.path.items():
                path[name] = yield from _value(text)
            move.path = PlannedPath.from_message(path) if "spline" in path else JointPath.from_message(path)
            yield
    return outline


def _value(raw: msgspec.Raw) -> Steps:
    text = bytes(raw).strip()
    try:
        if text[:1] == b"{":
            found: dict[str, Any] = {}
            for name, inner in _OBJECT.decode(text).items():
                found[name] = yield from _value(inner)
            return found
        if text[:1] == b"[" and len(text) > SLICE_bytes and b'"' not in text:
            return (yield from _numbers(text[1:-1].strip()))
        if len(text) > WORDS_bytes:
            raise ArmError(f"path: expected lists of numbers, got {len(text)} bytes of another kind")
        return msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ArmError(f"path: expected lists of numbers, all of the same length ({error})") from None


def _numbers(text: bytes) -> Generator[None, None, "NDArray[np.float64]"]:
    """A list of numbers, or of rows of them, whose brackets are left out."""
    import numpy as np

    decoder, end = (_ROWS, b"]") if text[:1] == b"[" else (_NUMBERS, b"")
    arrays, at = [], 0
    while at < len(text):
        until = text.find(end + b",", at + SLICE_bytes)
        until = len(text) if until < 0 else until + len(end)
        try:
            arrays.append(np.array(decoder.decode(b"[%b]" % text[at:until]), dtype=np.float64))
        except msgspec.DecodeError:  # a ValueError, too
            raise
        except ValueError:  # rows that are not equally long
            raise ArmError("path: expected rows of numbers, all of the same length") from None
        at = until + 1
        yield
    if len({array.shape[1:] for array in arrays}) != 1:
        raise ArmError("path: expected rows of numbers, all of the same length")
    return np.concatenate(arrays)
