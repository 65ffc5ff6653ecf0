"""What loop and drivers say to each other of a drive: what is wanted of it; flags, states and faults in the loop's `Feedback`.

The latter are those of the reference boards, into which other boards' are translated.
"""

from enum import Enum
from typing import Final


class Wanted(Enum):
    """What is wanted of every drive of an arm. The loop says it in each cycle, with what is to be commanded."""

    AS_FOUND = "nothing is commanded: each board goes on with what it did when it was connected"
    DISABLED = "no torque; a board that has it all the same is switched off"
    ENABLING = "all are taken to OPERATION ENABLED: by a person's request only"
    ENABLED = "those in operation are commanded; one that has left it is not taken back"

    def __init__(self, _: str) -> None:
        self.is_on: bool = self.name in ("ENABLING", "ENABLED")
        """Whether drives in operation are commanded."""


# Flags of an encoder channel, docs/encoder_board.md.
HOME_SWITCH: Final = 1 << 2
ZERO_SET: Final = 1 << 3
QUADRATURE_ERROR: Final = 1 << 4
SIGNAL_LOST: Final = 1 << 5
# Of a drive's own inputs for limit switches, in the joint's sense: no encoder channel has them.
LOWER_LIMIT: Final = 1 << 8
UPPER_LIMIT: Final = 1 << 9

# Statuswords of CiA 402, low byte, docs/motor_board.md.
STATE_MASK: Final = 0x6F
SWITCH_ON_DISABLED: Final = 0x40
OPERATION_ENABLED: Final = 0x27
FAULT: Final = 0x08
WARNING: Final = 0x80  # the board limits its output

# Faults of a drive.
OVER_CURRENT: Final = 1 << 0
OVER_TEMPERATURE: Final = 1 << 1
SUPPLY_LOW: Final = 1 << 2
SUPPLY_HIGH: Final = 1 << 3
WATCHDOG: Final = 1 << 4
OWN_ENCODER: Final = 1 << 5
BAD_COMMAND: Final = 1 << 6
EMERGENCY_STOP: Final = 1 << 7


def as_counter(count: int) -> int:
    """A count as a counter of 32 bits says it: boards that say turns, and zeros that are kept here, know no such end."""
    return (count + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000
