"""Faults of the arm: what happened, where, the remedy, and the reaction."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final


class Reaction(IntEnum):
    """How the arm comes to rest after a fault; the larger number is the more severe and wins."""

    CONTROLLED = 1  # feedback is good: jerk-limited stop, then hold the position
    HOLD = 2  # the loop's feedback is gone, the motors' is not: each board stops its joint and holds it by itself
    BRAKE = 3  # feedback cannot be trusted: 0 V on all joints, the shorted windings brake


# Faults after which counts mean no position any more, whatever the boards say: the arm must be homed.
LOSES_ZERO: Final = frozenset(
    {
        "zero_lost",
        "encoder_signal",
        "encoder_miscount",
        "encoder_leap",
        "overspeed",  # under control no joint is as fast: the count, or what moves it, is not what the loop takes it for
        "encoder_contradicted",
        "encoders_differ",
        "index_off",
        "switch_off",
    }
)


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault. `code` is stable for programs (`following_error`), `where` names joint or board for
    people.
    """

    code: str
    where: str
    message: str
    remedy: str
    reaction: Reaction

    def __str__(self) -> str:
        return f"{self.where}: {self.message}; {self.remedy}"
