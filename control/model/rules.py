"""Rules for values of an arm.toml beyond their type: a description and a test."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final


@dataclass(frozen=True, slots=True)
class Rule:
    """A condition on one value, its text for error messages, and a remedy if that is not obvious."""

    expected: str
    holds: Callable[[Any], bool]
    hint: str = ""


_RADIANS: Final = "angles are in radians: this looks like degrees"

POSITIVE: Final = Rule("a positive number", lambda x: x > 0)
NOT_NEGATIVE: Final = Rule("a number not below 0", lambda x: x >= 0)
SHARE_BELOW_1: Final = Rule("a share from 0.3 to 0.99", lambda x: 0.3 <= x <= 0.99)
SHARE_ABOVE_1: Final = Rule("a share from 1.01 to 2", lambda x: 1.01 <= x <= 2.0)
ZERO_OR_MORE: Final = Rule("a whole number not below 0", lambda n: n >= 0)
ONE_OR_MORE: Final = Rule("a whole number of 1 or more", lambda n: n >= 1)
ROTATE_BYTES: Final = Rule("a size of at least 1000000 bytes", lambda n: n >= 1_000_000)
DIRECTION: Final = Rule("1 or -1", lambda n: n in (1, -1))
NODE: Final = Rule("a motor node from 1 to 15", lambda n: 1 <= n <= 15)
ENCODER_BITS: Final = Rule("a counter width from 8 to 32 bits (a report has 32)", lambda n: 8 <= n <= 32)
ANGLE: Final = Rule("an angle within +-2 pi rad", lambda x: abs(x) <= 2 * math.pi, _RADIANS)
LIMIT: Final = Rule("an angle within four turns", lambda x: abs(x) <= 8 * math.pi, _RADIANS)
TILT: Final = Rule("a tilt within +-pi/2 rad", lambda x: abs(x) <= math.pi / 2, _RADIANS)
