"""The arm's mode by the table of control/safety/table.py, and its faults until a person acknowledges them.

A fault says what happened, where, the remedy, and the reaction.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from control.errors import ArmError
from control.safety.table import CONTROLLED_MODES, TRANSITIONS, Event, Mode, legal_events, next_towards_off


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


_FAULT_EVENTS = (Event.FAULT_CONTROLLED, Event.FAULT_BRAKE)
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
        names = ", ".join(entry.name for entry in legal if entry not in _FAULT_EVENTS)
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
        if event in _FAULT_EVENTS or event in _ACKNOWLEDGED.values():
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
        event = Event.FAULT_CONTROLLED if self.reaction is Reaction.CONTROLLED else Event.FAULT_BRAKE
        self.mode = TRANSITIONS[(self.mode, event)]
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
        """The next event of a shutdown, see `control.safety.table.next_towards_off`."""
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
