"""Flags, states and faults in the loop's `Feedback`: those of the reference boards, into which other boards' are translated."""

from typing import Final

# Flags of an encoder channel, docs/encoder_board.md.
HOME_SWITCH: Final = 1 << 2
ZERO_SET: Final = 1 << 3
QUADRATURE_ERROR: Final = 1 << 4
SIGNAL_LOST: Final = 1 << 5

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
