"""Modes and events of the arm in one transition table, which `armwright status --modes` prints; and the monitor that follows it,
with the arm's faults until a person acknowledges them.

A fault says what happened, where, the remedy, and the reaction.
"""

from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Final

from control.errors import ArmError


class Mode(Enum):
    """Mode of the arm; the value describes the drives."""

    OFF = "drives off: boards that short the windings let a loaded arm sink slowly; others free it, and it drops (docs/boards.md)"
    BRAKED = "no control: shorted windings brake; boards that cannot short them hold"
    HOLDING = "position control at a constant set-point"
    MOVING = "position control along a checked motion"
    HOMING = "position control; searches switches and index pulses"
    GUIDING = "a hand moves the arm: drives open circuit, or gravity compensation only"
    STOPPING = "position control along a jerk-limited stop"
    FAULT = "stop and hold, hold by the boards alone, or 0 V, depending on the fault; waits for acknowledgement"
    JOGGING = "position control along a jog that a client keeps renewing"
    PAUSED = "position control: slowing to rest along the motion, then holding there"
    HELD = "held by its boards: they had torque when the runtime connected; nothing is commanded, and no limit is watched"

    __hash__ = object.__hash__  # each cycle looks modes up; Enum's own is a call in Python


class Event(Enum):
    """An event; the value says who raises it and when."""

    FOUND_HELD = "loop, when it has connected: a board has torque that this runtime did not switch on"
    RELEASED = "loop: no board has torque any more"
    CONNECT = "operator: all boards answered, their identities match; drives go on, at 0 V"
    ENABLE = "operator: hold the present position"
    HOME = "operator: search the reference positions"
    HOMED = "loop: every joint has its zero (found, or still stored in the boards)"
    MOVE = "operator: start a checked motion"
    JOG = "operator: start or renew a jog"
    PAUSE = "operator: slow to rest along the motion and hold there"
    RESUME = "operator: continue the motion"
    ARRIVED = "loop: the motion, or a jog that was not renewed, has ended at rest"
    STOP = "operator, Ctrl-C, lost client: stop now"
    STOPPED = "loop: the jerk-limited stop has ended at rest"
    GUIDE = "operator: let a hand move the arm"
    BRAKE = "operator or shutdown: from position control or hand guiding to 0 V"
    SWITCH_OFF = "shutdown: the arm is at rest; drives switch off. From HELD: the operator lets it go"
    FAULT = "a fault: the loop stops the arm and holds it, the boards hold, or 0 V"
    ACKNOWLEDGE_HELD = "operator has read the faults; the arm was held"
    ACKNOWLEDGE_BRAKED = "operator has read the faults; the arm was braked, or its boards held it"
    ACKNOWLEDGE_OFF = "operator has read the faults; the drives were off"
    ACKNOWLEDGE_FOUND = "operator has read the faults; its boards still hold the arm as they were found"


# What is missing here is illegal and changes nothing. Why some rows are as they are:
# - STOP is legal wherever something could move, so that a stop can never be refused for being late.
# - Every mode has a fault row; OFF too: a fault found while connecting must be seen before any motion.
# - FAULT accepts BRAKE (shutdown from a held fault) and SWITCH_OFF; the faults stay listed until
#   acknowledged.
TRANSITIONS: Final[dict[tuple[Mode, Event], Mode]] = {
    (Mode.OFF, Event.FOUND_HELD): Mode.HELD,
    (Mode.OFF, Event.CONNECT): Mode.BRAKED,
    (Mode.OFF, Event.SWITCH_OFF): Mode.OFF,
    (Mode.OFF, Event.STOP): Mode.OFF,
    (Mode.OFF, Event.FAULT): Mode.FAULT,
    (Mode.OFF, Event.ACKNOWLEDGE_OFF): Mode.OFF,
    (Mode.BRAKED, Event.ENABLE): Mode.HOLDING,
    (Mode.BRAKED, Event.HOMED): Mode.BRAKED,
    (Mode.BRAKED, Event.GUIDE): Mode.GUIDING,
    (Mode.BRAKED, Event.STOP): Mode.BRAKED,
    (Mode.BRAKED, Event.BRAKE): Mode.BRAKED,
    (Mode.BRAKED, Event.SWITCH_OFF): Mode.OFF,
    (Mode.BRAKED, Event.FAULT): Mode.FAULT,
    (Mode.HOLDING, Event.HOME): Mode.HOMING,
    (Mode.HOLDING, Event.HOMED): Mode.HOLDING,
    (Mode.HOLDING, Event.MOVE): Mode.MOVING,
    (Mode.HOLDING, Event.JOG): Mode.JOGGING,
    (Mode.HOLDING, Event.STOP): Mode.HOLDING,
    (Mode.HOLDING, Event.GUIDE): Mode.GUIDING,
    (Mode.HOLDING, Event.BRAKE): Mode.BRAKED,
    (Mode.HOLDING, Event.FAULT): Mode.FAULT,
    (Mode.MOVING, Event.ARRIVED): Mode.HOLDING,
    (Mode.MOVING, Event.PAUSE): Mode.PAUSED,
    (Mode.MOVING, Event.RESUME): Mode.MOVING,
    (Mode.MOVING, Event.STOP): Mode.STOPPING,
    (Mode.MOVING, Event.FAULT): Mode.FAULT,
    (Mode.HOMING, Event.HOMED): Mode.HOLDING,
    (Mode.HOMING, Event.STOP): Mode.STOPPING,
    (Mode.HOMING, Event.FAULT): Mode.FAULT,
    (Mode.GUIDING, Event.STOP): Mode.BRAKED,
    (Mode.GUIDING, Event.BRAKE): Mode.BRAKED,
    (Mode.GUIDING, Event.FAULT): Mode.FAULT,
    (Mode.STOPPING, Event.STOPPED): Mode.HOLDING,
    (Mode.STOPPING, Event.STOP): Mode.STOPPING,
    (Mode.STOPPING, Event.FAULT): Mode.FAULT,
    (Mode.FAULT, Event.STOP): Mode.FAULT,
    (Mode.FAULT, Event.STOPPED): Mode.FAULT,
    (Mode.FAULT, Event.BRAKE): Mode.FAULT,
    (Mode.FAULT, Event.SWITCH_OFF): Mode.OFF,
    (Mode.FAULT, Event.FAULT): Mode.FAULT,
    (Mode.FAULT, Event.ACKNOWLEDGE_HELD): Mode.HOLDING,
    (Mode.FAULT, Event.ACKNOWLEDGE_BRAKED): Mode.BRAKED,
    (Mode.FAULT, Event.ACKNOWLEDGE_OFF): Mode.OFF,
    (Mode.FAULT, Event.ACKNOWLEDGE_FOUND): Mode.HELD,
    (Mode.JOGGING, Event.JOG): Mode.JOGGING,
    (Mode.JOGGING, Event.ARRIVED): Mode.HOLDING,
    (Mode.JOGGING, Event.STOP): Mode.STOPPING,
    (Mode.JOGGING, Event.FAULT): Mode.FAULT,
    (Mode.PAUSED, Event.PAUSE): Mode.PAUSED,
    (Mode.PAUSED, Event.RESUME): Mode.MOVING,
    (Mode.PAUSED, Event.ARRIVED): Mode.HOLDING,
    (Mode.PAUSED, Event.STOP): Mode.STOPPING,
    (Mode.PAUSED, Event.FAULT): Mode.FAULT,
    (Mode.HELD, Event.RELEASED): Mode.OFF,
    (Mode.HELD, Event.HOMED): Mode.HELD,
    (Mode.HELD, Event.ENABLE): Mode.HOLDING,
    (Mode.HELD, Event.STOP): Mode.HELD,
    (Mode.HELD, Event.SWITCH_OFF): Mode.OFF,
    (Mode.HELD, Event.FAULT): Mode.FAULT,
}

# Modes in which the arm executes a request (or is paused); a stop ends them.
TRAVELLING_MODES: Final = frozenset({Mode.MOVING, Mode.HOMING, Mode.JOGGING, Mode.PAUSED})
# Modes with position control, in which a controlled stop is possible; in all others every fault brakes.
CONTROLLED_MODES: Final = TRAVELLING_MODES | {Mode.HOLDING, Mode.STOPPING}


def legal_events(mode: Mode) -> tuple[Event, ...]:
    """Events with a row for `mode`, in the order of `Event`."""
    return tuple(event for event in Event if (mode, event) in TRANSITIONS)


def next_towards_off(mode: Mode, is_still: bool, is_held_fault: bool = False) -> Event | None:
    """The next event of a shutdown, or None to wait (or if it is complete).

    Called each cycle from Ctrl-C on. It never drops the arm: stop, hold, 0 V when at rest, off when at rest
    at 0 V. `is_still`: the measured speed of every joint was zero for long enough. `is_held_fault`: FAULT,
    position held. HELD is never left by itself: somebody must hold the arm before it is let go.
    """
    if mode in TRAVELLING_MODES:
        return Event.STOP
    if mode is Mode.GUIDING:
        return Event.BRAKE
    if not is_still or mode in (Mode.OFF, Mode.STOPPING, Mode.HELD):
        return None
    if mode is Mode.HOLDING or is_held_fault:
        return Event.BRAKE
    return Event.SWITCH_OFF


def table_text() -> str:
    """Every mode, and every event with the next mode of each mode, as `armwright status --modes` prints them."""
    lines = [
        "Modes, and what the drives do",
        *(f"  {mode.name:<9} {mode.value}" for mode in Mode),
        "",
        "Events: when one is raised, and from which modes it leads where. In any other mode it is refused and changes nothing.",
        *(f"  {event.name}: {event.value}\n    {_transitions_in_words(event)}" for event in Event),
        "",
        _NOTES,
    ]
    return "\n".join(lines)


def _transitions_in_words(event: Event) -> str:
    """`A, B → C; D → E`: the modes in which an event is legal, by the mode that follows."""
    origins: dict[Mode, list[str]] = {}
    for mode in Mode:
        if following := TRANSITIONS.get((mode, event)):
            origins.setdefault(following, []).append(mode.name)
    return "; ".join(
        f"{'all' if len(names) == len(Mode) else ', '.join(names)} → {following.name}" for following, names in origins.items()
    )


_NOTES: Final = """Beyond the table (docs/safety.md, docs/socket.md)
  CONNECT is refused while faults are not acknowledged, MOVE while a joint has no zero.
  A jog that is not renewed slows to rest (ARRIVED); one whose connection closes gets a STOP.
  PAUSED begins while the arm still slows down; a motion that ends meanwhile raises ARRIVED.
  Acknowledging, after the controlled stop, switches no drive on; in OFF it only clears the list.
  Shutdown (Ctrl-C, an error): stop, hold, 0 V at rest, off when still at rest. Ctrl-C in HELD leaves the arm held.
  From OFF the arm is BRAKED until all drives are on. From HELD its boards hold it until then; `stop` or `off` meanwhile is
  done from HOLDING."""


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


_ACKNOWLEDGED = {
    Mode.HOLDING: Event.ACKNOWLEDGE_HELD,
    Mode.BRAKED: Event.ACKNOWLEDGE_BRAKED,
    Mode.OFF: Event.ACKNOWLEDGE_OFF,
    Mode.HELD: Event.ACKNOWLEDGE_FOUND,
}


class IllegalTransition(ArmError):
    """An event that is illegal in the present mode; nothing was changed. Carries mode and legal events."""

    def __init__(self, mode: Mode, event: str, legal: tuple[Event, ...], why: str = "") -> None:
        self.mode = mode
        self.event = event
        self.legal = legal
        self.why = why
        names = ", ".join(entry.name for entry in legal if entry is not Event.FAULT)
        reason = f": {why}" if why else f"; accepted: {names}"
        super().__init__(f"the arm is in {mode.name} and does not accept {event} now{reason}")


class Monitor:
    """Mode, faults and homing of one arm. Independent of time and hardware: the loop raises events and follows the mode.

    Only its methods write its attributes. They are no properties: each cycle asks for them some thirty times.
    """

    __slots__ = ("faults", "is_at_rest", "is_homed", "is_zero_doubted", "mode", "reaction")

    def __init__(self) -> None:
        self.mode = Mode.OFF
        self.faults: tuple[Fault, ...] = ()
        """Not yet acknowledged, the first one first."""
        self.reaction: Reaction | None = None
        """To the present faults; None if there are none."""
        self.is_homed = False
        """Every joint is."""
        self.is_zero_doubted = False
        """The boards' own zeros are not to be used: a count went wrong, and homing must find them anew."""
        self.is_at_rest = True
        """The stop after a fault has ended; before that it cannot be acknowledged."""

    @property
    def is_held_fault(self) -> bool:
        """Whether the arm is in FAULT under position control (stopping or holding), not at 0 V."""
        return self.mode is Mode.FAULT and self.reaction is Reaction.CONTROLLED

    def on(self, event: Event) -> Mode:
        """Take `event` and return the new mode.

        Raises:
            IllegalTransition: no such transition, the arm is not homed, or faults are unacknowledged; nothing changes.
        """
        following = self.require(event)
        self._note(event)
        self.mode = following
        return following

    def require(self, event: Event) -> Mode:
        """Return the mode that `event` leads to; raises as `on` and changes nothing."""
        if event is Event.FAULT or event in _ACKNOWLEDGED.values():
            raise self._refusal(event.name, "use fault() and acknowledge()")
        following = TRANSITIONS.get((self.mode, event))
        if following is None:
            raise self._refusal(event.name)
        if event is Event.CONNECT:
            self.require_no_faults(event.name)
        if event is Event.MOVE and not self.is_homed:
            raise self._refusal(event.name, "not every joint is homed, home the arm first (`armwright home`)")
        return following

    def require_no_faults(self, event: str) -> None:
        """Raise IllegalTransition for `event` while faults are unacknowledged."""
        if self.faults:
            raise self._refusal(event, "faults are not acknowledged (`armwright acknowledge`)")

    def fault(self, fault: Fault) -> Mode:
        """Go to FAULT, list `fault` (once per code and place), use the more severe reaction. Always legal."""
        # The boards hold only what the loop controlled before, or what they hold already.
        can_control = self.mode in CONTROLLED_MODES or self.reaction in (Reaction.CONTROLLED, Reaction.HOLD)
        wanted = fault.reaction if can_control else Reaction.BRAKE
        if self.mode is Mode.HELD:
            wanted = max(fault.reaction, Reaction.HOLD)
        if self.mode is not Mode.FAULT:
            # Even at rest the loop plans a stop, and ends it with STOPPED at once.
            self.is_at_rest = False
        if all((known.code, known.where) != (fault.code, fault.where) for known in self.faults):
            self.faults = (*self.faults, fault)
        if fault.code in LOSES_ZERO:
            self.is_homed, self.is_zero_doubted = False, True
        self.reaction = wanted if self.reaction is None else max(self.reaction, wanted)
        self.mode = TRANSITIONS[(self.mode, Event.FAULT)]
        return self.mode

    def acknowledge(self, uncontrolled: Mode = Mode.BRAKED) -> tuple[Fault, ...]:
        """Clear and return the faults. The mode becomes HOLDING if the loop held the arm, else `uncontrolled`; OFF stays.

        `uncontrolled`: BRAKED, OFF or HELD, by what is wanted of the drives.

        Raises:
            IllegalTransition: there is no fault, or the controlled stop has not ended; nothing changes.
        """
        if not self.faults:
            raise self._refusal("ACKNOWLEDGE", "there is no fault")
        if self.is_held_fault and not self.is_at_rest:
            raise self._refusal("ACKNOWLEDGE", "the stop has not ended, try again when the arm is at rest")
        leads_to = Mode.OFF if self.mode is Mode.OFF else Mode.HOLDING if self.is_held_fault else uncontrolled
        self.mode = TRANSITIONS[(self.mode, _ACKNOWLEDGED[leads_to])]
        cleared, self.faults, self.reaction = self.faults, (), None
        return cleared

    def forget_home(self) -> None:
        """Note that a board lost its zero (power, broken wire): MOVE is refused until HOMED."""
        self.is_homed = False

    def next_towards_off(self, is_still: bool) -> Event | None:
        """The next event of a shutdown, see `control.safety.modes.next_towards_off`."""
        return next_towards_off(self.mode, is_still, self.is_held_fault)

    def _note(self, event: Event) -> None:
        """Effects of an event beyond the mode."""
        if event is Event.HOMED:
            self.is_homed, self.is_zero_doubted = True, False
        elif event is Event.HOME:
            self.is_homed = False
        elif event is Event.STOPPED:
            self.is_at_rest = True
        elif event is Event.BRAKE and self.mode is Mode.FAULT:
            self.reaction = Reaction.BRAKE

    def _refusal(self, event: str, why: str = "") -> IllegalTransition:
        return IllegalTransition(self.mode, event, legal_events(self.mode), why)
