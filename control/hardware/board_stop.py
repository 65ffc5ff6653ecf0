"""What the boards do while the host pauses, and how a motion goes on after it.

A motor board that hears nothing for `stop_after_s` brings its joint to rest within `stop_time_s` by itself, and holds it
(docs/motor_board.md). All joints slow down by the same law, so the arm stays on its path; the host knows the law, and takes the
motion up where and as fast as it then is. Nothing leaps ahead to where it would have been, and nothing snaps back.
"""

import math
from typing import Final, NamedTuple

from control.model.arm import Arm, Drive

STOP_AFTER_CYCLES: Final = 12
STOP_AFTER_LEAST_S: Final = 0.01
STOP_AFTER_MOST_S: Final = 0.05
STAYS_AFTER_S: Final = 0.01  # of boards that stay at the last position: the motion waits for them, and does not leap ahead
STAYING_STOP_S: Final = 0.05  # in which such a board has lost most of its speed
HARDER: Final = 2.0  # a board's stop brakes by this times the joint's acceleration limit, from its speed limit

BRAKED_STOP_S: Final = 0.04  # twice the time constant of shorted windings on the reference arm
DEFAULT_STOP_S: Final = 0.1  # of an arm whose drives have no limits


class Bridge(NamedTuple):
    """A pause as the arm saw it: the time by which its motion went on, and the share of its speed that is left."""

    motion_s: float
    speed_share: float


class BoardStop(NamedTuple):
    """When the boards begin their stop without the host, how long it takes, and whether they follow the motion until then."""

    after_s: float
    time_s: float
    follows: bool = True  # False where a board stays at the last position

    def bridge(self, pause_s: float) -> Bridge | None:
        """What a pause of the host meant for the motion; None if it was too short for the boards to stop."""
        over_s = pause_s - self.after_s
        if over_s <= 0.0:
            return None
        if not self.follows:
            return Bridge(0.0, max(0.0, 1.0 - over_s / STAYING_STOP_S))
        if over_s >= self.time_s:
            return Bridge(self.after_s + 0.5 * self.time_s, 0.0)
        share = 1.0 - over_s / self.time_s
        return Bridge(self.after_s + 0.5 * over_s * (1.0 + share), share)


def can_hold(drive: Drive) -> bool:
    """Whether the motor board may control the joint by its own encoder; else it brakes where it would hold."""
    return (drive.board_holds and knows_motor(drive)) or drive.pid.mode == "position"


def knows_motor(drive: Drive) -> bool:
    """Whether the motor board reads an encoder on the motor; a bought board knows its own."""
    return drive.at_motor.encoder_on == "motor" or bool(drive.board)


def stop_after_s(period_s: float) -> float:
    """How long a board waits for the next command: some cycles, whatever the rate of the loop."""
    return min(max(STOP_AFTER_CYCLES * period_s, STOP_AFTER_LEAST_S), STOP_AFTER_MOST_S)


def board_stop(arm: Arm, period_s: float) -> BoardStop:
    """The stop of an arm's boards, the same for all joints."""
    times_s = [drive.joint_speed_limit_rad_s / (HARDER * drive.joint_acceleration_limit_rad_s2) for drive in arm.drives]
    after_s = min(_after_s(arm, drive, period_s) for drive in arm.drives)
    if not all(can_hold(drive) and arm.kind_of(drive).can_hold for drive in arm.drives):
        return BoardStop(after_s, BRAKED_STOP_S)
    finite_s = [time_s for time_s in times_s if 0.0 < time_s < math.inf]
    follows = not any(_stays(arm, drive) for drive in arm.drives)
    return BoardStop(after_s, max(finite_s, default=DEFAULT_STOP_S), follows)


def _stays(arm: Arm, drive: Drive) -> bool:
    """Whether its board stays at the last position that it was told."""
    return drive.pid.mode == "position" and not arm.kind_of(drive).moves_on


def _after_s(arm: Arm, drive: Drive, period_s: float) -> float:
    """A board that neither stops early nor stays goes on with the last command until its watchdog, and so does the motion."""
    if arm.kind_of(drive).stops_early:
        return stop_after_s(period_s)
    return STAYS_AFTER_S if _stays(arm, drive) else arm.limits.watchdog_s
