"""The arm's mode by the table of control/safety/table.py, and its faults until a person acknowledges them."""

from control.errors import ArmError
from control.safety.fault import LOSES_ZERO, Fault, Reaction
from control.safety.table import CONTROLLED_MODES, TRANSITIONS, Event, Mode, legal_events, next_towards_off

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
    """Mode, faults and homing of one arm. Independent of time and hardware: the loop raises events and follows the mode."""

    __slots__ = ("_faults", "_is_at_rest", "_is_homed", "_is_zero_doubted", "_mode", "_reaction")

    def __init__(self) -> None:
        self._mode = Mode.OFF
        self._faults: tuple[Fault, ...] = ()
        self._reaction: Reaction | None = None
        self._is_homed = False
        self._is_zero_doubted = False
        self._is_at_rest = True

    @property
    def mode(self) -> Mode:
        """The present mode."""
        return self._mode

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Faults not yet acknowledged, the first one first."""
        return self._faults

    @property
    def reaction(self) -> Reaction | None:
        """The reaction to the present faults; None if there are none."""
        return self._reaction

    @property
    def is_at_rest(self) -> bool:
        """Whether the stop after a fault has ended; before that it cannot be acknowledged."""
        return self._is_at_rest

    @property
    def is_homed(self) -> bool:
        """Whether every joint is homed."""
        return self._is_homed

    @property
    def is_zero_doubted(self) -> bool:
        """Whether the boards' own zeros are not to be used: a count went wrong, and homing must find them anew."""
        return self._is_zero_doubted

    @property
    def is_held_fault(self) -> bool:
        """Whether the arm is in FAULT under position control (stopping or holding), not at 0 V."""
        return self._mode is Mode.FAULT and self._reaction is Reaction.CONTROLLED

    def on(self, event: Event) -> Mode:
        """Take `event` and return the new mode.

        Raises:
            IllegalTransition: no such transition, the arm is not homed, or faults are unacknowledged; nothing changes.
        """
        following = self.require(event)
        self._note(event)
        self._mode = following
        return following

    def require(self, event: Event) -> Mode:
        """Return the mode that `event` leads to; raises as `on` and changes nothing."""
        if event in _FAULT_EVENTS or event in _ACKNOWLEDGED.values():
            raise self._refusal(event.name, "use fault() and acknowledge()")
        following = TRANSITIONS.get((self._mode, event))
        if following is None:
            raise self._refusal(event.name)
        if event is Event.CONNECT:
            self.require_no_faults(event.name)
        if event is Event.MOVE and not self._is_homed:
            raise self._refusal(event.name, "not every joint is homed, home the arm first (`armwright home`)")
        return following

    def require_no_faults(self, event: str) -> None:
        """Raise IllegalTransition for `event` while faults are unacknowledged."""
        if self._faults:
            raise self._refusal(event, "faults are not acknowledged (`armwright acknowledge`)")

    def fault(self, fault: Fault) -> Mode:
        """Go to FAULT, list `fault` (once per code and place), use the more severe reaction. Always legal."""
        # The boards hold only what the loop controlled before, or what they hold already.
        can_control = self._mode in CONTROLLED_MODES or self._reaction in (Reaction.CONTROLLED, Reaction.HOLD)
        wanted = fault.reaction if can_control else Reaction.BRAKE
        if self._mode is Mode.HELD:
            wanted = max(fault.reaction, Reaction.HOLD)
        if self._mode is not Mode.FAULT:
            # Even at rest the loop plans a stop, and ends it with STOPPED at once.
            self._is_at_rest = False
        if all((known.code, known.where) != (fault.code, fault.where) for known in self._faults):
            self._faults = (*self._faults, fault)
        if fault.code in LOSES_ZERO:
            self._is_homed, self._is_zero_doubted = False, True
        self._reaction = wanted if self._reaction is None else max(self._reaction, wanted)
        event = Event.FAULT_CONTROLLED if self._reaction is Reaction.CONTROLLED else Event.FAULT_BRAKE
        self._mode = TRANSITIONS[(self._mode, event)]
        return self._mode

    def acknowledge(self, uncontrolled: Mode = Mode.BRAKED) -> tuple[Fault, ...]:
        """Clear and return the faults. The mode becomes HOLDING if the loop held the arm, else `uncontrolled`; OFF stays.

        `uncontrolled`: BRAKED, OFF or HELD, by what is wanted of the drives.

        Raises:
            IllegalTransition: there is no fault, or the controlled stop has not ended; nothing changes.
        """
        if not self._faults:
            raise self._refusal("ACKNOWLEDGE", "there is no fault")
        if self.is_held_fault and not self._is_at_rest:
            raise self._refusal("ACKNOWLEDGE", "the stop has not ended, try again when the arm is at rest")
        leads_to = (
            Mode.OFF if self._mode is Mode.OFF else Mode.HOLDING if self.is_held_fault else uncontrolled
        )
        self._mode = TRANSITIONS[(self._mode, _ACKNOWLEDGED[leads_to])]
        cleared, self._faults, self._reaction = self._faults, (), None
        return cleared

    def forget_home(self) -> None:
        """Note that a board lost its zero (power, broken wire): MOVE is refused until HOMED."""
        self._is_homed = False

    def next_towards_off(self, is_still: bool) -> Event | None:
        """The next event of a shutdown, see `control.safety.table.next_towards_off`."""
        return next_towards_off(self._mode, is_still, self.is_held_fault)

    def _note(self, event: Event) -> None:
        """Effects of an event beyond the mode."""
        if event is Event.HOMED:
            self._is_homed, self._is_zero_doubted = True, False
        elif event is Event.HOME:
            self._is_homed = False
        elif event is Event.STOPPED:
            self._is_at_rest = True
        elif event is Event.BRAKE and self._mode is Mode.FAULT:
            self._reaction = Reaction.BRAKE

    def _refusal(self, event: str, why: str = "") -> IllegalTransition:
        return IllegalTransition(self._mode, event, legal_events(self._mode), why)
