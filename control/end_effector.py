"""What an arm has at its end: the gripper, and digital outputs with the levels of all named pins.

The gripper opens, closes, goes to an opening, and holds what it has with a force. Voltage of its motor: u = K v + R i, with
K = 2 pi k_t / travel per turn, which is also the force per current. On its way a speed controller adds R i to K v_set, within the
voltages that keep the current at that of the wanted force. Where the fingers are stopped says what it has come to: its end, or
something, which it then holds with R i alone. Nothing here moves without a request: enabled, after a stop, a time-out or a
fault, it holds where it is.

An output is set by a request and stays. When the arm goes to FAULT or its drives go off, each goes to its safe level, and stays
there until it is set anew: nothing comes on again by itself. The boards do the same without the host.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, Protocol

from control.errors import ArmError
from control.hardware.interface import GripperFeedback, GripperHardware, NamedPins
from control.model.can_bus import GRIPPER_PERIOD_s, PIN_PERIOD_s
from control.model.end_effector import Digital, Gripper
from control.safety.limits import voltage_range
from control.safety.modes import Fault, Reaction
from firmware_iface.errors import BoardReset


class GripState(Enum):
    """What the gripper does; the value is for people."""

    OFF = "drives off"
    HOLDING = "holds its opening"
    MOVING = "on its way"
    OPEN = "open"
    CLOSED = "closed, nothing held"
    GRIPPED = "holds something"
    STOPPED = "stopped before its goal"
    RELEASED = "without current"
    FAILED = "its board does not work"


@dataclass(frozen=True, slots=True)
class Goal:
    """An opening [m] (None: as far as it goes, in the direction of `sign`), and the force [N] with which to get there."""

    opening_m: float | None
    force_N: float
    sign: int  # 1 opens, -1 closes


SILENT: Final = 3.0  # times `stale_s`, of the loop's attention: six COMMANDs without an answer at 20 ms
UNCOUNTED: Final = 7.5  # the same of a count, which comes after its question
ENABLE_LIMIT_s: Final = 1.0
RESET_s: Final = 0.04  # of a fault that was acknowledged: some cycles
APPROACH_per_s: Final = 10.0  # speed per distance from the goal: slow against the fingers' own time constant
SPEED_LAG_s: Final = 0.02  # of the measured speed, which comes from counts 10 ms apart
FULL_FORCE_s: Final = 0.2  # until fingers that do not move are pushed with the whole force
STALL_s: Final = 0.15
STALL_SPEED: Final = 0.05  # of the speed limit
STALL_CURRENT: Final = 0.7  # of that of the wanted force
FULL_STALL_s: Final = 0.5  # without an encoder only the current says that it stands
TRIM_per_s: Final = 2.0  # of the held current, which R alone gives to some 10 % (a warm winding)
TRIM_MOST: Final = 0.3
TIME_EXTRA_s: Final = 2.0  # beyond the travel at the speed limit
END_SHARE: Final = 0.01  # of the travel: this near its ends it is open or closed; thinner things are not noticed
END_LEAST_m: Final = 3e-4
THERE_SHARE: Final = 0.0025  # of the travel: this near its goal it is there
THERE_LEAST_m: Final = 1e-4


class GripperControl:
    """One gripper. `cycle` is called in each control cycle, and works every GRIPPER_PERIOD_s.

    `stale_s`: of the arm's limits; a bus that may keep the joints' values waiting for longer does so with the gripper's.
    """

    def __init__(self, described: Gripper, board: GripperHardware, stale_s: float) -> None:
        self.state = GripState.OFF
        self.goal: Goal | None = None
        self.why = ""  # it stopped, or does not work
        self.has_lost = False  # what it held, since the last request
        self.number = 0  # of the last request
        self.opening_m: float | None = None  # None: no encoder, or its zero is unknown
        self.described = described
        self.feedback: GripperFeedback = board.feedback
        self._board = board
        self._zero_m: float | None = None  # `moved_m` when closed
        self._next_s = -math.inf
        self._last_s: float | None = None
        self._enabled_s = math.inf
        self._speed_m_s, self._before_m = 0.0, math.nan
        self._heard = (-math.inf, -math.inf)
        self._silent_s, self._without_count_s = SILENT * stale_s, UNCOUNTED * stale_s
        self._unheard_s = self._uncounted_s = 0.0
        self._hold_m: float | None = None  # `moved_m` of the place to hold
        self._left_s = self._push_A = self._trim_A = self._stalled_s = 0.0

    # ---- requests

    def require(self, opening_m: float | None, force_N: float | None) -> float:
        """The force of a request. ArmError if the gripper cannot get to the opening, or cannot push as hard."""
        gripper = self.described
        force = gripper.usual_force_N if force_N is None else force_N
        if not 0.0 < force <= gripper.force_limit_N:
            raise ArmError(
                f"gripper: expected a force above 0 and up to {gripper.force_limit_N:.1f} N (current_limit_A), got {force:g} N"
            )
        if opening_m is None:
            return force
        if not gripper.encoder_counts_per_rev:
            raise ArmError("gripper: it has no encoder, so it can only open and close")
        if not 0.0 <= opening_m <= gripper.travel_m:
            raise ArmError(f"gripper: expected an opening of 0 to {gripper.travel_m:g} m (travel_m), got {opening_m:g} m")
        if self._zero_m is None:
            raise ArmError("gripper: its opening is not known since power-up: `armwright gripper open` finds it")
        return force

    def ask(self, action: str, opening_m: float | None, force_N: float | None) -> None:
        """`action`: open, close or move (to `opening_m`). ArmError says why not, and then nothing changes."""
        force = self.require(opening_m, force_N)
        if self.state in (GripState.OFF, GripState.FAILED):
            raise ArmError(f"gripper: {self.why or GripState.OFF.value}: enable the drives first (`armwright enable`)")
        if action == "move" and opening_m is not None:
            sign = 1 if opening_m >= (self.opening_m or 0.0) else -1
            self._start(Goal(opening_m, force, sign))
        else:
            sign = 1 if action == "open" else -1
            known = self._zero_m is not None
            end_m = (self.described.travel_m if sign > 0 else 0.0) if known else None
            self._start(Goal(end_m, force, sign))

    def stop(self) -> None:
        """Hold where it is, if it was on its way; what is held stays held."""
        if self.state is GripState.MOVING:
            self._settle(GripState.STOPPED, "by request")

    # ---- the cycle

    def cycle(self, now_s: float, is_ready: bool, is_fault: bool, is_off: bool) -> Fault | None:
        """One control cycle; the fault of its board, once.

        `is_ready`: the joints' drives are enabled. `is_fault`: the arm is in FAULT. `is_off`: the drives are off.
        """
        feedback = self._board.read(now_s)
        self._note_opening()
        is_early = now_s < self._next_s and feedback.problem is None  # which is said once
        if is_early and (feedback.is_enabled or not is_ready):
            return None  # on its way to OPERATION ENABLED it is as quick as the joints' boards
        self._next_s = now_s + GRIPPER_PERIOD_s - 1e-6
        elapsed_s = GRIPPER_PERIOD_s if self._last_s is None else min(now_s - self._last_s, 3.0 * GRIPPER_PERIOD_s)
        self._last_s = now_s
        self._listen(feedback)
        fault = None if is_off else self._trouble(now_s, is_ready, feedback)
        self._follow(is_ready, is_fault, is_off)
        self._measure_speed(elapsed_s)
        self._command(elapsed_s, now_s)
        return fault

    def _command(self, elapsed_s: float, now_s: float) -> None:
        self._board.write(self._volts(elapsed_s), now_s)

    def recover(self) -> None:
        """A person acknowledges its fault. ArmError while its board is silent: a question to it would keep the arm waiting."""
        if self._unheard_s > self._silent_s:
            raise ArmError(f"gripper: {self.why}: check its supply and cable, then acknowledge again")
        self.state, self.why, self._enabled_s = GripState.OFF, "", math.inf

    def _follow(self, is_ready: bool, is_fault: bool, is_off: bool) -> None:
        """Off and on with the joints' drives; what a fault of the arm does to it."""
        if is_off:
            self.state = GripState.OFF
            self._enabled_s = math.inf
        elif self.state is GripState.OFF and is_ready and self.feedback.is_enabled:
            self._settle(GripState.HOLDING, "")
        elif is_fault and self.described.on_fault == "release" and self.state not in (GripState.OFF, GripState.FAILED):
            self.state = GripState.RELEASED
        elif is_fault and self.state is GripState.MOVING:
            self._settle(GripState.STOPPED, "by a fault of the arm")

    def _trouble(self, now_s: float, is_ready: bool, feedback: GripperFeedback) -> Fault | None:
        """What is wrong with the board, once."""
        if feedback.problem is not None:
            self._zero_m = None
            is_reset = isinstance(feedback.problem, BoardReset)
            restarted = "its motor board restarted: its opening is unknown, and what it held may be gone"
            return self._fail("gripper_link", restarted if is_reset else str(feedback.problem))
        if not is_ready or self.state is GripState.FAILED:
            return None
        if self._enabled_s == math.inf:
            self._enabled_s = now_s
        waited_s = now_s - self._enabled_s
        if self._unheard_s > self._silent_s:
            return self._fail("gripper_silent", f"no reply from its motor board for {self._silent_s:g} s")
        if feedback.faults and waited_s > RESET_s:
            return self._fail("gripper_drive", f"its motor board is in FAULT ({feedback.faults})")
        if not feedback.is_enabled and waited_s > ENABLE_LIMIT_s:
            return self._fail("gripper_drive", f"its drive is not enabled after {ENABLE_LIMIT_s} s")
        if self.described.encoder_counts_per_rev and self._uncounted_s > self._without_count_s:
            return self._fail("gripper_count", f"no count from its motor board for {self._without_count_s:g} s")
        return None

    def _listen(self, feedback: GripperFeedback) -> None:
        """How long nothing has come, while the loop asked: a pause of the host makes no board silent."""
        heard = feedback.reply_at_s, feedback.moved_at_s
        self._unheard_s = 0.0 if heard[0] != self._heard[0] else self._unheard_s + GRIPPER_PERIOD_s
        self._uncounted_s = 0.0 if heard[1] != self._heard[1] else self._uncounted_s + GRIPPER_PERIOD_s
        self._heard = heard

    def _fail(self, code: str, message: str) -> Fault:
        self.state, self.why = GripState.FAILED, message
        remedy = "check its supply, cable and what it holds; then acknowledge"
        return Fault(code, "gripper", message, remedy, Reaction.CONTROLLED)

    # ---- its motion

    def _start(self, goal: Goal) -> None:
        self.goal, self.state, self.why, self.has_lost = goal, GripState.MOVING, "", False
        self.number += 1
        self._left_s = self.described.travel_m / self.described.speed_limit_m_s + TIME_EXTRA_s
        self._push_A = self._trim_A = self._stalled_s = 0.0
        self._hold_m = None

    def _settle(self, state: GripState, why: str) -> None:
        """It has come to an end: brake, and hold where it then is."""
        self.state, self.why = state, why
        self._push_A = self._trim_A = self._stalled_s = 0.0
        self._hold_m = None
        self._take_place()

    def _take_place(self) -> None:
        if abs(self._speed_m_s) < self._slow_m_s and not math.isnan(self.feedback.moved_m):
            self._hold_m = self.feedback.moved_m

    def _note_opening(self) -> None:
        moved_m = self.feedback.moved_m
        self.opening_m = None if self._zero_m is None or math.isnan(moved_m) else moved_m - self._zero_m

    def _measure_speed(self, elapsed_s: float) -> None:
        moved_m = self.feedback.moved_m
        if math.isnan(self._before_m):
            self._before_m = moved_m
        if math.isnan(moved_m):
            return
        speed = (moved_m - self._before_m) / elapsed_s
        self._before_m = moved_m
        self._speed_m_s += (speed - self._speed_m_s) * elapsed_s / (elapsed_s + SPEED_LAG_s)

    def _volts(self, elapsed_s: float) -> float | None:
        """The voltage of this cycle; None: open circuit."""
        if self.state is GripState.RELEASED or (self.state is GripState.FAILED and self.described.on_fault == "release"):
            return None
        if self.state is GripState.MOVING:
            return self._on_its_way(elapsed_s)
        if self.state is GripState.GRIPPED and self.goal is not None:
            return self._held(self.goal, elapsed_s)
        if self._hold_m is None:
            self._take_place()
        if self.state in (GripState.OFF, GripState.FAILED) or self._hold_m is None:
            return 0.0
        return self._servo(self._hold_m - self.feedback.moved_m, self._force_A(), elapsed_s)

    def _force_A(self) -> float:
        force_N = self.goal.force_N if self.goal is not None else self.described.usual_force_N
        return force_N / self.described.constant_N_A

    def _on_its_way(self, elapsed_s: float) -> float:
        goal = self.goal
        return 0.0 if goal is None else self._servo(self._looked(goal, elapsed_s), self._force_A(), elapsed_s)

    def _looked(self, goal: Goal, elapsed_s: float) -> float:
        """How far it still is [m], after having looked whether its motion has ended."""
        self._left_s -= elapsed_s
        left_m = math.copysign(math.inf, goal.sign)
        if goal.opening_m is not None and self.opening_m is not None:
            left_m = goal.opening_m - self.opening_m
        if abs(left_m) <= self._there_m and abs(self._speed_m_s) < self._slow_m_s:
            self._arrive(goal)
        elif self._is_stalled(goal, elapsed_s):
            self._meet(goal)
        elif self._left_s <= 0.0:
            self._settle(GripState.STOPPED, "it did not get there in time")
        return left_m

    def _servo(self, left_m: float, most_A: float, elapsed_s: float) -> float:
        """Voltage of the speed controller, towards a place that is `left_m` away."""
        gripper = self.described
        K, R, fastest = gripper.constant_N_A, gripper.resistance_ohm, gripper.speed_limit_m_s
        if not gripper.encoder_counts_per_rev:
            return math.copysign(min(R * most_A, K * fastest), left_m)
        if abs(left_m) <= 0.5 * self._there_m:
            self._push_A *= 1.0 - elapsed_s / FULL_FORCE_s  # near enough: no hunting against dry friction
            left_m = 0.0
        wanted = min(max(APPROACH_per_s * left_m, -fastest), fastest)
        gain = most_A / (fastest * FULL_FORCE_s)
        self._push_A += gain * (wanted - self._speed_m_s) * elapsed_s
        self._push_A = min(max(self._push_A, -most_A), most_A)
        lower, upper = voltage_range(gripper.supply_V, most_A, R, K * self._speed_m_s)
        return min(max(K * wanted + R * self._push_A, lower), upper)

    def _is_stalled(self, goal: Goal, elapsed_s: float) -> bool:
        """It pushes with the wanted force and does not move."""
        if self.described.encoder_counts_per_rev:
            stands, needed_s = abs(self._speed_m_s) < self._slow_m_s, STALL_s
        else:
            stands, needed_s = True, FULL_STALL_s
        pushes = goal.sign * self.feedback.current_A >= STALL_CURRENT * self._stall_A()
        self._stalled_s = self._stalled_s + elapsed_s if stands and pushes else 0.0
        return self._stalled_s >= needed_s

    def _stall_A(self) -> float:
        """The current of fingers that stand."""
        gripper, most_A = self.described, self._force_A()
        if gripper.encoder_counts_per_rev:
            return most_A
        return min(most_A, gripper.constant_N_A * gripper.speed_limit_m_s / gripper.resistance_ohm)

    def _arrive(self, goal: Goal) -> None:
        is_end = goal.opening_m in (0.0, self.described.travel_m)
        self._settle((GripState.OPEN if goal.sign > 0 else GripState.CLOSED) if is_end else GripState.HOLDING, "")

    def _meet(self, goal: Goal) -> None:
        """Something stopped it: its own end, or what it is to hold."""
        moved_m, travel_m = self.feedback.moved_m, self.described.travel_m
        if self._zero_m is None and goal.sign > 0 and not math.isnan(moved_m):
            self._zero_m = moved_m - travel_m
            self._note_opening()
        end_m = travel_m if goal.sign > 0 else 0.0
        is_end = self.opening_m is not None and abs(self.opening_m - end_m) <= self._near_m
        if is_end or (goal.sign > 0 and not self.described.encoder_counts_per_rev):
            self._settle(GripState.OPEN if goal.sign > 0 else GripState.CLOSED, "")
        else:
            self._settle(GripState.GRIPPED, "")

    def _held(self, goal: Goal, elapsed_s: float) -> float:
        """The voltage that holds with the force; what it held may go, and then it goes on to its end."""
        if self._has_slipped(goal):
            self._go_on(goal)
            return self._on_its_way(elapsed_s)
        wanted_A = goal.sign * self._force_A()
        most_A = TRIM_MOST * abs(wanted_A)
        self._trim_A += TRIM_per_s * elapsed_s * (wanted_A - self.feedback.current_A)
        self._trim_A = min(max(self._trim_A, -most_A), most_A)
        return self.described.resistance_ohm * (wanted_A + self._trim_A)

    def _has_slipped(self, goal: Goal) -> bool:
        hold_m = self._hold_m
        return hold_m is not None and goal.sign * (self.feedback.moved_m - hold_m) > self._near_m

    def _go_on(self, goal: Goal) -> None:
        """To its end, as what it held is gone; nobody's request."""
        number = self.number
        self._start(goal)
        self.number, self.has_lost = number, True

    @property
    def _near_m(self) -> float:
        return max(END_SHARE * self.described.travel_m, END_LEAST_m)

    @property
    def _there_m(self) -> float:
        return max(THERE_SHARE * self.described.travel_m, THERE_LEAST_m)

    @property
    def _slow_m_s(self) -> float:
        return STALL_SPEED * self.described.speed_limit_m_s


# A gripper on a board with a position loop and a force limit of its own, such as a smart servo: places and forces, no voltages.
#
# The place runs ahead of the fingers at the speed limit, and no further than LEAD_SHARE of the travel, where the board pushes
# with the wanted force.

LEAD_SHARE: Final = 0.15  # of the travel: a position loop of usual gain then gives all that it may


class PlacedHardware(GripperHardware, Protocol):
    """A motor that goes to places."""

    def place(self, moved_m: float | None, force_A: float, now_s: float) -> None:
        """Go to where the fingers have moved by so much, with at most this current; None: let go."""
        ...


class PlacedGripper(GripperControl):
    """As `GripperControl`; what it commands are places."""

    def __init__(self, described: Gripper, board: PlacedHardware, stale_s: float) -> None:
        super().__init__(described, board, stale_s)
        self._placed = board
        self._aim_m = math.nan  # `moved_m` of the place that it goes to

    def _command(self, elapsed_s: float, now_s: float) -> None:
        self._placed.place(self._place_m(elapsed_s), self._force_A(), now_s)

    def _place_m(self, elapsed_s: float) -> float | None:
        moved_m, goal = self.feedback.moved_m, self.goal
        is_let_go = self.state is GripState.RELEASED or (self.state is GripState.FAILED and self.described.on_fault == "release")
        if is_let_go or math.isnan(moved_m):
            return None
        if self.state is GripState.GRIPPED and goal is not None and self._has_slipped(goal):
            self._go_on(goal)
        if self.state is GripState.MOVING and goal is not None:
            left_m = self._looked(goal, elapsed_s)
            if self.state is GripState.MOVING:
                return self._ahead(moved_m, left_m, goal.sign, elapsed_s)
        if self.state is GripState.GRIPPED:
            return self._aim_m
        self._aim_m = math.nan
        if self._hold_m is None:
            self._take_place()
        return moved_m if self._hold_m is None else self._hold_m

    def _ahead(self, moved_m: float, left_m: float, sign: int, elapsed_s: float) -> float:
        """The next place on its way; an end is pushed into, another goal is not passed."""
        gripper = self.described
        lead_m = LEAD_SHARE * gripper.travel_m
        step_m = sign * gripper.speed_limit_m_s * elapsed_s
        aim_m = (moved_m if math.isnan(self._aim_m) else self._aim_m) + step_m
        aim_m = min(max(aim_m, moved_m - lead_m), moved_m + lead_m)
        is_end = self.goal is None or self.goal.opening_m in (None, 0.0, gripper.travel_m)
        if not is_end and abs(aim_m - moved_m) > abs(left_m):
            aim_m = moved_m + left_m
        self._aim_m = aim_m
        return aim_m


class Outputs:
    """The pins of one arm. `cycle` is called in each control cycle."""

    def __init__(self, described: Sequence[Digital], pins: NamedPins) -> None:
        self.described = tuple(described)
        self.levels: dict[str, bool | None] = {pin.name: None for pin in described}
        self._by_name = {pin.name: pin for pin in described}
        self._pins = pins
        self._wanted: dict[str, bool] = {}
        self._next_s = -math.inf
        self._was_safe = True

    def set(self, name: str, level: bool) -> None:
        """Set an output. ArmError if there is none of this name, or while outputs have their safe levels."""
        pin = self._by_name.get(name)
        outputs = ", ".join(p.name for p in self.described if p.direction == "output") or "none"
        if pin is None:
            raise ArmError(f"digital: no pin {name!r}: expected one of the outputs {outputs}")
        if pin.direction != "output":
            raise ArmError(f"digital: {name} is an input: expected one of the outputs {outputs}")
        if self._was_safe:
            raise ArmError(
                f"digital: {name} has its safe level ({pin.safe}) while the drives are off or the arm is in FAULT: enable first"
            )
        self._wanted[name] = level
        self._next_s = -math.inf

    def cycle(self, now_s: float, is_safe: bool) -> None:
        """One control cycle; `is_safe`: the arm is in FAULT, or its drives are not enabled."""
        if is_safe and not self._was_safe:
            self._wanted = {
                name: level if self._by_name[name].safe == "keep" else self._by_name[name].safe == "high"
                for name, level in self._wanted.items()
            }
            self._next_s = -math.inf
        self._was_safe = is_safe
        self.levels = self._pins.levels(now_s)
        if now_s >= self._next_s:
            self._next_s = now_s + PIN_PERIOD_s - 1e-6
            self._pins.command(self._wanted)
