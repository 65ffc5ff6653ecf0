"""What bought boards on a CAN bus have in common that send what they measure: line, encoder, latched faults; and of those
that close the position loop themselves, or take a torque (moteus, ODrive), the drive.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

from control.errors import MissingModel
from control.hardware import interface
from control.hardware.boards import AskedEncoders, Line, Opened
from control.hardware.interface import Feedback, OutputMode
from control.model.arm import Drive
from control.model.drive import JointMap
from firmware_iface.clock import Clock
from firmware_iface.errors import BoardFaulted
from firmware_iface.link import FrameLink
from firmware_iface.node_bus import Dating

B = TypeVar("B", bound=Line)


class CountingNode(Protocol):
    """A board with an encoder, seen from the host. Counts are in its own sense."""

    count: int
    resets: int

    @property
    def is_switch_on(self) -> bool: ...
    @property
    def counted(self) -> Dating: ...
    def await_count(self) -> None: ...


class CanNode(CountingNode, Protocol):
    """A board, seen from the host. Amperes are in its own sense."""

    current_A: float
    supply_V: float
    temperature_degC: float

    @property
    def where(self) -> str: ...
    @property
    def at_s(self) -> float: ...
    @property
    def is_known(self) -> bool: ...
    def await_status(self) -> None: ...


class BusLine:
    """The bus, as the loop drains it; meets `control.hardware.boards.Line`."""

    def __init__(self, bus: Line) -> None:
        self.update = bus.update
        self.flush = bus.flush


class NodeEncoder(AskedEncoders):
    """The encoder of a board, whose zero is kept here; meets `control.hardware.boards.Encoders`."""

    def __init__(self, board: CountingNode, joint: int, is_absolute: bool = False, is_asked: bool = False) -> None:
        """`is_absolute`: its count at power-up is the joint's, so that its zero is always known."""
        self.joints = (joint,)
        self.is_asked = is_asked
        self.offset = 0
        """What is added to the count: the zero is set here."""
        self._joint, self._board, self._is_absolute = joint, board, is_absolute
        self._is_zero_set = is_absolute
        self._latched: int | None = None
        self._resets = 0

    def take(self, feedback: Feedback) -> None:
        """Write the newest count."""
        board, joint = self._board, self._joint
        if self._resets != board.resets:
            self._resets, self._is_zero_set, self._latched = board.resets, self._is_absolute, None
        feedback.count[joint] = interface.as_counter(board.count + self.offset)
        counted = board.counted
        feedback.counted_at_s[joint] = feedback.reported_at_s[joint] = counted.at_s
        feedback.count_late_s[joint] = counted.late_s
        flags = interface.ZERO_SET if self._is_zero_set else 0
        feedback.channel_flags[joint] = flags | (interface.HOME_SWITCH if board.is_switch_on else 0)

    def fresh_count(self, joint: int) -> int:
        """A count that is sent from now on. BoardSilent if there is none."""
        self._board.await_count()
        return self._board.count + self.offset

    def arm_index(self, joint: int) -> None:
        """The count at which the home switch is seen takes the index's place."""
        self._latched = self._board.count + self.offset

    def index_count(self, joint: int) -> int | None:
        """The count at the switch."""
        return self._latched

    def shift(self, joint: int, counts: int) -> None:
        """Shift the zero, which is kept here."""
        self.fresh_count(joint)
        self.offset += counts
        self._is_zero_set = True


class NodeDrive(ABC):
    """One motor of a board without states or with fewer than the loop's: faults are kept here.

    Meets `control.hardware.boards.Drives`, with what a kind adds.
    """

    def __init__(self, board: CanNode, encoder: NodeEncoder | None, drive: Drive) -> None:
        """`encoder`: the board's own, None if the loop uses another."""
        self._node, self._encoder, self._joint = board, encoder, drive.joint - 1
        self.joints = (self._joint,)
        self._map = JointMap(drive)
        self._sign = float(drive.motor_direction)
        self._configured_resets = -1
        self._faults = 0
        self._is_enabled = False

    @abstractmethod
    def _faults_now(self) -> int:
        """What the board reports, as the loop's faults."""

    @abstractmethod
    def _fault_left(self) -> str:
        """End a fault whose cause is gone, and say in words what is left of it."""

    def _set_up(self) -> None:  # noqa: B027
        """Set what a restart of the board forgets."""

    def configure(self, fresh_count: Callable[[int], int]) -> None:
        """Set what a restart of the board forgets, once, and wait for its values."""
        resets = self._node.resets
        if self._configured_resets != resets:
            self._set_up()
            self._configured_resets = resets
        self._node.await_status()

    def acknowledge_faults(self) -> None:
        """Forget a fault that is gone. BoardFaulted if its cause persists."""
        if left := self._fault_left():
            raise BoardFaulted(f"{self._node.where}: its {left} cannot be acknowledged: the cause persists")
        self._faults = 0

    def _is_driving(self) -> bool:
        """Whether the board is in operation, by its own word where it has one."""
        return self._is_enabled

    def take(self, feedback: Feedback) -> None:
        """Write current, supply, temperature and state."""
        board, joint = self._node, self._joint
        feedback.reply_at_s[joint] = board.at_s
        if not board.is_known or math.isnan(board.supply_V):
            feedback.statusword[joint] = 0
            return
        self._faults |= self._faults_now()
        feedback.current_A[joint] = self._sign * board.current_A
        feedback.supply_V[joint] = board.supply_V
        feedback.temperature_C[joint] = board.temperature_degC
        feedback.drive_faults[joint] = self._faults
        state = interface.OPERATION_ENABLED if self._is_driving() else interface.SWITCH_ON_DISABLED
        feedback.statusword[joint] = interface.FAULT if self._faults else state

    def _may_drive(self, wanted: interface.Wanted, is_in_operation: bool = True) -> bool:
        """Whether a board that is set up and without a fault is wanted to drive: one in operation, or all that are to be enabled.

        A board without states of its own is in operation as long as it is obeyed.
        """
        is_wanted = wanted is interface.Wanted.ENABLING or (wanted is interface.Wanted.ENABLED and is_in_operation)
        return is_wanted and self._configured_resets == self._node.resets and not self._faults

    def is_any_enabled(self) -> bool:
        """Whether the motor may be driven."""
        return self._is_driving()

    def has_torque(self, joint: int) -> bool:
        """Whether the board drives its motor now, as far as it says so."""
        return self._is_driving()

    def follow_shift(self, joint: int, fresh_count: Callable[[int], int]) -> None:  # noqa: B027
        """The encoder's offset is used with every position."""


def open_bus(opened: Opened, called: str, open_link: Callable[..., FrameLink], make: Callable[[FrameLink, Clock], B]) -> B:
    """Open the bus of [can] for a kind of boards, `called` so in messages. MissingModel, LinkError."""
    arm = opened.arm
    if arm.can is None:
        raise MissingModel(f"arm {arm.name}: no [can] bus for its {called}: add it")
    link = open_link(arm.can.interface, arm.can.channel, arm.can.bitrate, **arm.can.options)
    opened.closers.append(link.close)
    bus = make(link, opened.clock)
    opened.lines.append(BusLine(bus))
    return bus


def own_encoder(
    board: CountingNode, drive: Drive, opened: Opened, is_absolute: bool = False, is_asked: bool = False
) -> NodeEncoder | None:
    """The board's own encoder, added to `opened`; None if the drive names an encoder board's."""
    if drive.encoder_board >= 0:
        return None
    encoder = NodeEncoder(board, drive.joint - 1, is_absolute, is_asked)
    opened.encoders.append(encoder)
    return encoder


class SetPointSpeed:
    """The speed of a joint's set-point in counts/s, which a board that closes the position loop is told beside the count.

    A late cycle moves the set-point further, in a longer time; no step may look faster than the joint's limit.
    """

    def __init__(self, drive: Drive, opened: Opened) -> None:
        self._clock, self._period_s = opened.clock, opened.period_s
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
    """One motor; meets `control.hardware.boards.Drives`, with what a kind adds."""

    def __init__(self, board: CanNode, encoder: NodeEncoder | None, drive: Drive, speed: SetPointSpeed) -> None:
        """`encoder`: the board's own, None if the loop uses another."""
        super().__init__(board, encoder, drive)
        self._torque_Nm_A = self._sign * drive.torque_constant_Nm_A
        self._speed = speed
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
        self,
        wanted: interface.Wanted,
        modes: Sequence[OutputMode],
        output: Sequence[float],
        feedforward_V: Sequence[float],
        feedback: Feedback,
    ) -> None:
        """Set the command of this cycle."""
        joint = self._joint
        feedback.sent_V[joint] = math.nan
        self._is_enabled = self._may_drive(wanted, self._is_in_operation())
        self._is_to_let_go = wanted is interface.Wanted.DISABLED
        if wanted is interface.Wanted.AS_FOUND:
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
