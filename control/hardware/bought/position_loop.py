"""What CAN boards have in common that close the position loop themselves, or take a torque: moteus and ODrive."""

import math
from abc import abstractmethod
from collections.abc import Sequence

from control.hardware.bought.can_node import CanNode, NodeDrive, NodeEncoder
from control.hardware.interface import Feedback, OutputMode
from control.hardware.words import Wanted
from control.model.arm import Drive
from control.model.joint_map import JointMap
from firmware_iface.clock import Clock


class SetPointSpeed:
    """The speed of a joint's set-point in counts/s, which a board that closes the position loop is told beside the count.

    A late cycle moves the set-point further, in a longer time; no step may look faster than the joint's limit.
    """

    def __init__(self, drive: Drive, clock: Clock, period_s: float) -> None:
        self._clock, self._period_s = clock, period_s
        counts_per_radian = abs(JointMap(drive).counts_per_radian)
        self._most_count_s = drive.joint_speed_limit_rad_s * counts_per_radian
        self._last: tuple[int, float] | None = None

    def of(self, count: int) -> float:
        """The speed now that `count` is commanded; 0 after another mode."""
        now_s = self._clock.now_s()
        last, self._last = self._last, (count, now_s)
        if last is None:
            return 0.0
        speed = (count - last[0]) / max(now_s - last[1], self._period_s)
        return min(max(speed, -self._most_count_s), self._most_count_s)

    def forget(self) -> None:
        """Another mode is commanded."""
        self._last = None


class PositionLoopDrive(NodeDrive):
    """One motor; meets `control.hardware.roles.Drives`, with what a kind adds."""

    def __init__(
        self, board: CanNode, encoder: NodeEncoder | None, joint: int, drive: Drive, clock: Clock, period_s: float
    ) -> None:  # fmt: skip
        """`encoder`: the board's own, None if the loop uses another. `period_s`: of the cycle."""
        super().__init__(board, encoder, joint, drive)
        self._torque_Nm_A = self._sign * drive.torque_constant_Nm_A
        self._speed = SetPointSpeed(drive, clock, period_s)
        self._held: int | None = None
        self._is_to_let_go = False

    @abstractmethod
    def _is_in_operation(self) -> bool:
        """Whether the board obeys set-points, by its own word."""

    @abstractmethod
    def _look(self) -> None:
        """Command nothing at all; only ask for values, where they are not sent unasked."""

    @abstractmethod
    def _go(self, count: int, speed_count_s: float) -> None:
        """Command the board to be at a count that moves at a speed."""

    @abstractmethod
    def _push(self, torque_Nm: float) -> None:
        """Command a torque of the motor."""

    @abstractmethod
    def _brake(self) -> None:
        """Command nothing: what the board does then, in operation and out of it."""

    def write(
        self, wanted: Wanted, modes: Sequence[OutputMode], output: Sequence[float],
        feedforward_V: Sequence[float], feedback: Feedback,
    ) -> None:  # fmt: skip
        """Set the command of this cycle."""
        joint = self._joint
        feedback.sent_V[joint] = math.nan
        self._is_enabled = self._may_drive(wanted, self._is_in_operation())
        self._is_to_let_go = wanted is Wanted.DISABLED
        if wanted is Wanted.AS_FOUND:
            self._look()
            return
        mode = modes[joint] if self._is_enabled else OutputMode.VOLTAGE
        if mode is not OutputMode.POSITION:
            self._speed.forget()
        if mode in (OutputMode.POSITION, OutputMode.CURRENT, OutputMode.OFF):
            self._held = None
        if mode is OutputMode.POSITION and self._encoder is not None:
            count = self._map.count(output[joint]) - self._encoder.offset
            self._go(count, self._speed.of(count))
        elif mode is OutputMode.HOLD:
            self._hold()
        elif mode is OutputMode.CURRENT:
            self._push(self._torque_Nm_A * output[joint])
        elif mode is OutputMode.OFF:
            self._push(0.0)
        else:
            self._brake()

    def _hold(self) -> None:
        """Stay where the joint was when this began."""
        self._held = self._node.count if self._held is None else self._held
        self._go(self._held, 0.0)
