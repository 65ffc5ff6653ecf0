"""Rules for values of an arm.toml beyond their type: a description, a test, and which other unit a value may be in.

The bounds leave room for the largest and the smallest serial arms: links of 7 m (Canadarm2) and of 10 mm, joints of 30 rad/s.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from control.model.board_kinds import KINDS


@dataclass(frozen=True, slots=True)
class Rule:
    """A condition on one value, its text for error messages, and a remedy if that is not obvious.

    `looks_like` is the unit that a refused value is probably in, `factor` what it has to be multiplied with.
    """

    expected: str
    holds: Callable[[Any], bool]
    hint: str = ""
    looks_like: str = ""
    factor: float = 1.0

    def remedy(self, value: Any) -> str:
        """What to do about a refused value."""
        if not self.looks_like:
            return self.hint
        return f"this looks like {self.looks_like}: write {_converted(value, self.factor)}"

    def doubt(self, value: Any) -> str:
        """The remedy in brackets, for the end of another error about a value that does not hold here; empty if it does."""
        return "" if self.holds(value) else f" ({self.remedy(value)})"


def _converted(value: Any, factor: float) -> str:
    if isinstance(value, tuple | list):
        return f"[{', '.join(_converted(one, factor) for one in value)}]"
    return f"{factor * value:.6g}"


_DEG: Final = ("", "degrees", math.pi / 180)
_MM: Final = ("", "millimetres", 1e-3)
_GRAMS: Final = ("", "grams", 1e-3)

LONGEST_NAME = 64  # a socket's whole path has 107 characters


def is_file_name(name: str) -> bool:
    """Whether a name can be part of a file's name and leads to no other folder."""
    return bool(name) and len(name) <= LONGEST_NAME and name[0] not in ".-" and not re.search(r"[/\\\x00-\x1f\x7f]", name)


NAME: Final = Rule(
    f"a name of 1 to {LONGEST_NAME} characters, without / and \\, that does not begin with . or -",
    is_file_name,
    "sockets and recordings are named after the arm",
)
INVENTED: Final = re.compile(r"(joint|link|fixed|base|tip) ?\d*|world")
PART_NAME: Final = Rule(
    f"a name of 1 to {LONGEST_NAME} characters, without / and \\, that does not begin with . or -, and is not joint N, link N,"
    " base, tip or world",
    lambda name: is_file_name(name) and not INVENTED.fullmatch(name),
    "rows without a name are called so: another one's would be told, and models would have it twice",
)
LONGEST_WORD = 32
WORD: Final = Rule(
    f"a name of 1 to {LONGEST_WORD} letters, digits, - and _, that begins with a letter",
    lambda name: bool(re.fullmatch(rf"[A-Za-z][A-Za-z0-9_-]{{0,{LONGEST_WORD - 1}}}", name)),
)
# What protects the arm may be set wider than its default, but not without end.
WATCHDOG: Final = Rule(
    "a time from 0.005 to 1 s", lambda x: 0.005 <= x <= 1.0, "until then a board acts on a host that may be dead"
)
STALE: Final = Rule("a time up to 0.5 s, above 0", lambda x: 0.0 < x <= 0.5, "until then the arm is controlled by old values")
FOLLOWING: Final = Rule(
    "an angle up to 0.5 rad, above 0", lambda x: 0.0 < x <= 0.5, "a joint that is further off follows nothing"
)
LAG: Final = Rule("a time from 0 to 0.5 s", lambda x: 0.0 <= x <= 0.5, "a joint that is later follows nothing")
POSITIVE: Final = Rule("a positive number", lambda x: x > 0)
NOT_NEGATIVE: Final = Rule("a number not below 0", lambda x: x >= 0)
SHARE_BELOW_1: Final = Rule("a share from 0.3 to 0.99", lambda x: 0.3 <= x <= 0.99)
SHARE_ABOVE_1: Final = Rule("a share from 1.01 to 2", lambda x: 1.01 <= x <= 2.0)
ZERO_OR_MORE: Final = Rule("a whole number not below 0", lambda n: n >= 0)
ONE_OR_MORE: Final = Rule("a whole number of 1 or more", lambda n: n >= 1)
ROTATE_BYTES: Final = Rule("a size of at least 1000000 bytes", lambda n: n >= 1_000_000)
DIRECTION: Final = Rule("1 or -1", lambda n: n in (1, -1))
KIND: Final = Rule(f"a kind of board: {', '.join(KINDS)}", lambda kind: kind in KINDS)
NODE: Final = Rule("a motor node from 1 to 15", lambda n: 1 <= n <= 15)
PIN: Final = Rule("a pin from 0 to 7", lambda n: 0 <= n <= 7)
ENCODER_BITS: Final = Rule("a counter width from 8 to 32 bits (a report has 32)", lambda n: 8 <= n <= 32)
UDP_PORT: Final = Rule("a UDP port from 1 to 65535", lambda n: 1 <= n <= 65535)
ANGLE: Final = Rule("an angle within +-2 pi rad", lambda x: abs(x) <= 2 * math.pi, *_DEG)
LIMIT: Final = Rule("an angle within four turns, in rad", lambda x: abs(x) <= 8 * math.pi, *_DEG)
TILT: Final = Rule("a tilt within +-pi/2 rad", lambda x: abs(x) <= math.pi / 2, *_DEG)
BACKOFF: Final = Rule("an angle up to 1 rad", lambda x: x <= 1.0, *_DEG)
JOINT_SPEED: Final = Rule("a speed up to 50 rad/s", lambda x: x <= 50.0, "", "degrees per second", math.pi / 180)
STEP: Final = Rule("a step within +-1 m", lambda x: abs(x) <= 1.0, *_MM)
LENGTH: Final = Rule("a length within +-10 m", lambda x: abs(x) <= 10.0, *_MM)
POSITION: Final = Rule("coordinates within +-10 m", lambda v: max(map(abs, v)) <= 10.0, *_MM)
HEIGHT: Final = Rule("a height within +-10 m", lambda x: abs(x) <= 10.0, *_MM)
BOARD_SIZE: Final = Rule("a length up to 3 m", lambda x: x <= 3.0, *_MM)
CLEARANCE: Final = Rule("a distance up to 1 m", lambda x: x <= 1.0, *_MM)
CAMERA_NOISE: Final = Rule("a noise up to 0.05 m", lambda x: x <= 0.05, *_MM)
TURN_NOISE: Final = Rule("a noise up to 0.05 rad", lambda x: x <= 0.05, *_DEG)
QUATERNION: Final = Rule("a unit quaternion w, x, y, z (length 1 within 0.002)", lambda q: abs(math.hypot(*q) - 1.0) <= 2e-3)
TIP_SPEED: Final = Rule("a speed up to 20 m/s", lambda x: x <= 20.0, "", "millimetres per second", 1e-3)
PAYLOAD: Final = Rule("a mass up to 3000 kg", lambda x: x <= 3000.0, *_GRAMS)
TOOL_MASS: Final = Rule("a mass up to 100 kg", lambda x: x <= 100.0, *_GRAMS)
TRAVEL: Final = Rule("a length up to 0.5 m", lambda x: x <= 0.5, *_MM)
FINGER_SPEED: Final = Rule("a speed up to 2 m/s", lambda x: x <= 2.0, "", "millimetres per second", 1e-3)
ROTOR: Final = Rule("an inertia up to 0.5 kg m^2", lambda x: x <= 0.5, "", "g cm^2", 1e-7)
GRAVITY: Final = Rule("an acceleration up to 30 m/s^2", lambda v: math.hypot(*v) <= 30.0, "", "millimetres per s^2", 1e-3)
