"""The whole table of modes and events, and what the monitor holds beyond it."""

import itertools
import re

import pytest

from control.safety.modes import (
    LOSES_ZERO,
    TRANSITIONS,
    Event,
    Fault,
    IllegalTransition,
    Mode,
    Monitor,
    Reaction,
    legal_events,
    next_towards_off,
    table_text,
)
from tests.places import ROOT

CONTROLLED = Fault("following_error", "joint 2", "0.2 rad behind its set-point", "free the arm", Reaction.CONTROLLED)
BRAKE = Fault("stale_encoder", "board enc0", "no report for 0.05 s", "check its cable", Reaction.BRAKE)

# Written out again on purpose, by mode: a change of the table must be made twice.
EXPECTED = {
    Mode.OFF: "FOUND_HELD>HELD CONNECT>BRAKED SWITCH_OFF>OFF STOP>OFF",
    Mode.BRAKED: "ENABLE>HOLDING HOMED>BRAKED GUIDE>GUIDING STOP>BRAKED BRAKE>BRAKED SWITCH_OFF>OFF",
    Mode.HOLDING: "HOME>HOMING HOMED>HOLDING MOVE>MOVING JOG>JOGGING STOP>HOLDING GUIDE>GUIDING BRAKE>BRAKED",
    Mode.MOVING: "ARRIVED>HOLDING STOP>STOPPING PAUSE>PAUSED RESUME>MOVING",
    Mode.JOGGING: "JOG>JOGGING ARRIVED>HOLDING STOP>STOPPING",
    Mode.PAUSED: "PAUSE>PAUSED RESUME>MOVING ARRIVED>HOLDING STOP>STOPPING",
    Mode.HOMING: "HOMED>HOLDING STOP>STOPPING",
    Mode.GUIDING: "STOP>BRAKED BRAKE>BRAKED",
    Mode.STOPPING: "STOPPED>HOLDING STOP>STOPPING",
    Mode.FAULT: "STOP>FAULT STOPPED>FAULT BRAKE>FAULT SWITCH_OFF>OFF",
    Mode.HELD: "RELEASED>OFF HOMED>HELD ENABLE>HOLDING STOP>HELD SWITCH_OFF>OFF",
}
ROUTES = {
    Mode.OFF: (),
    Mode.HELD: (Event.FOUND_HELD,),
    Mode.BRAKED: (Event.CONNECT,),
    Mode.HOLDING: (Event.CONNECT, Event.HOMED, Event.ENABLE),
    Mode.MOVING: (Event.CONNECT, Event.HOMED, Event.ENABLE, Event.MOVE),
    Mode.HOMING: (Event.CONNECT, Event.ENABLE, Event.HOME),
    Mode.JOGGING: (Event.CONNECT, Event.HOMED, Event.ENABLE, Event.JOG),
    Mode.PAUSED: (Event.CONNECT, Event.HOMED, Event.ENABLE, Event.MOVE, Event.PAUSE),
    Mode.GUIDING: (Event.CONNECT, Event.GUIDE),
    Mode.STOPPING: (Event.CONNECT, Event.HOMED, Event.ENABLE, Event.MOVE, Event.STOP),
}
INTERNAL = {Event.FAULT, Event.ACKNOWLEDGE_HELD, Event.ACKNOWLEDGE_BRAKED, Event.ACKNOWLEDGE_OFF, Event.ACKNOWLEDGE_FOUND}
# What the loop does not control it cannot stop; boards that hold by themselves go on.
UNCONTROLLED = {Mode.OFF: Reaction.BRAKE, Mode.BRAKED: Reaction.BRAKE, Mode.GUIDING: Reaction.BRAKE, Mode.HELD: Reaction.HOLD}


def _monitor(mode):
    monitor = Monitor()
    for event in ROUTES[Mode.HOLDING if mode is Mode.FAULT else mode]:
        monitor.on(event)
    if mode is Mode.FAULT:
        monitor.fault(CONTROLLED)
    assert monitor.mode is mode
    return monitor


def _state(monitor):
    return monitor.mode, monitor.faults, monitor.reaction, monitor.is_homed, monitor.is_at_rest


@pytest.mark.parametrize(("mode", "event"), list(itertools.product(Mode, [event for event in Event if event not in INTERNAL])))
def test_every_event_in_every_mode_does_what_the_table_says_or_is_refused_without_a_trace(mode, event):
    expected = dict(entry.split(">") for entry in EXPECTED[mode].split())
    monitor = _monitor(mode)
    before = _state(monitor)
    if event.name in expected:
        assert monitor.on(event) is Mode[expected[event.name]]
        assert monitor.mode is Mode[expected[event.name]]
    else:
        with pytest.raises(IllegalTransition) as caught:
            monitor.on(event)
        assert _state(monitor) == before
        assert caught.value.mode is mode
        assert caught.value.event == event.name
        assert caught.value.legal == legal_events(mode)
        assert all(name in str(caught.value) for name in (mode.name, event.name, *expected))
        assert "FAULT_" not in str(caught.value)


@pytest.mark.parametrize("event", sorted(INTERNAL, key=lambda event: event.name))
def test_fault_and_acknowledgement_events_go_through_their_own_methods(event):
    monitor = _monitor(Mode.HOLDING)
    with pytest.raises(IllegalTransition, match=r"use fault\(\) and acknowledge\(\)"):
        monitor.on(event)
    assert monitor.mode is Mode.HOLDING


@pytest.mark.parametrize(("mode", "fault"), list(itertools.product(Mode, [CONTROLLED, BRAKE])))
def test_a_fault_is_taken_in_every_mode_and_brakes_where_nothing_is_controlled(mode, fault):
    monitor = _monitor(mode)
    assert monitor.fault(fault) is Mode.FAULT
    assert monitor.mode is Mode.FAULT
    assert fault in monitor.faults
    assert monitor.reaction is max(fault.reaction, UNCONTROLLED.get(mode, Reaction.CONTROLLED))
    assert monitor.is_held_fault is (mode not in UNCONTROLLED and fault is CONTROLLED)


@pytest.mark.parametrize("order", [(CONTROLLED, BRAKE), (BRAKE, CONTROLLED)])
def test_of_two_faults_the_more_severe_reaction_wins_and_both_are_kept(order):
    monitor = _monitor(Mode.MOVING)
    for fault in order:
        monitor.fault(fault)
    assert monitor.reaction is Reaction.BRAKE
    assert monitor.faults == order
    assert not monitor.is_held_fault


def test_the_same_fault_cycle_after_cycle_is_listed_once_but_another_place_is_another_fault():
    monitor = _monitor(Mode.MOVING)
    elsewhere = Fault(CONTROLLED.code, "joint 3", "m", "r", Reaction.CONTROLLED)
    other_code = Fault("over_speed", CONTROLLED.where, "m", "r", Reaction.CONTROLLED)
    for fault in (CONTROLLED, CONTROLLED, elsewhere, other_code, CONTROLLED):
        monitor.fault(fault)
    assert monitor.faults == (CONTROLLED, elsewhere, other_code)


def test_a_fault_while_stopping_ends_in_fault_and_the_stop_still_has_to_end():
    monitor = _monitor(Mode.STOPPING)
    monitor.fault(CONTROLLED)
    with pytest.raises(IllegalTransition, match="stop has not ended"):
        monitor.acknowledge()
    assert monitor.on(Event.STOPPED) is Mode.FAULT
    assert monitor.acknowledge() == (CONTROLLED,)
    assert monitor.mode is Mode.HOLDING


def test_a_second_controlled_fault_at_rest_does_not_ask_for_another_stop():
    monitor = _monitor(Mode.FAULT)
    monitor.on(Event.STOPPED)
    monitor.fault(Fault("x", "joint 1", "m", "r", Reaction.CONTROLLED))
    monitor.acknowledge()
    assert monitor.mode is Mode.HOLDING


def test_a_held_fault_is_acknowledged_to_holding_only_at_rest():
    monitor = _monitor(Mode.MOVING)
    monitor.fault(CONTROLLED)
    before = _state(monitor)
    with pytest.raises(IllegalTransition, match="ACKNOWLEDGE"):
        monitor.acknowledge()
    assert _state(monitor) == before
    monitor.on(Event.STOPPED)
    assert monitor.acknowledge() == (CONTROLLED,)
    assert (monitor.mode, monitor.faults, monitor.reaction) == (Mode.HOLDING, (), None)


def test_a_braked_fault_is_acknowledged_to_braked_at_any_time():
    monitor = _monitor(Mode.MOVING)
    monitor.fault(BRAKE)
    assert monitor.acknowledge() == (BRAKE,)
    assert (monitor.mode, monitor.faults, monitor.reaction) == (Mode.BRAKED, (), None)


@pytest.mark.parametrize("leads_to", [Mode.OFF, Mode.HELD, Mode.BRAKED])
def test_a_fault_of_an_arm_that_was_off_or_held_by_its_boards_is_acknowledged_to_that(leads_to):
    monitor = _monitor(Mode.OFF if leads_to is Mode.BRAKED else leads_to)
    monitor.fault(BRAKE)
    monitor.acknowledge(leads_to)
    assert monitor.mode is leads_to
    monitor.fault(BRAKE)
    monitor.on(Event.SWITCH_OFF)
    monitor.acknowledge(leads_to)
    assert monitor.mode is Mode.OFF


@pytest.mark.parametrize("mode", [mode for mode in Mode if mode is not Mode.FAULT])
def test_without_a_fault_there_is_nothing_to_acknowledge(mode):
    monitor = _monitor(mode)
    with pytest.raises(IllegalTransition, match="there is no fault"):
        monitor.acknowledge()
    assert monitor.mode is mode


def test_switched_off_in_fault_the_faults_stay_and_must_be_acknowledged_before_connecting():
    monitor = _monitor(Mode.FAULT)
    monitor.on(Event.BRAKE)
    assert monitor.reaction is Reaction.BRAKE
    assert monitor.on(Event.SWITCH_OFF) is Mode.OFF
    with pytest.raises(IllegalTransition, match="acknowledged"):
        monitor.on(Event.CONNECT)
    assert monitor.acknowledge() == (CONTROLLED,)
    assert monitor.mode is Mode.OFF
    assert monitor.on(Event.CONNECT) is Mode.BRAKED


def test_braking_from_holding_is_no_fault_reaction():
    monitor = _monitor(Mode.HOLDING)
    monitor.on(Event.BRAKE)
    assert monitor.reaction is None


def test_an_arm_that_is_not_homed_does_not_move_and_says_so():
    monitor = _monitor(Mode.HOMING)
    assert not monitor.is_homed
    monitor.on(Event.STOP)
    monitor.on(Event.STOPPED)
    with pytest.raises(IllegalTransition, match="home the arm first"):
        monitor.on(Event.MOVE)
    assert monitor.mode is Mode.HOLDING
    monitor.on(Event.HOME)
    monitor.on(Event.HOMED)
    assert monitor.is_homed
    assert monitor.on(Event.MOVE) is Mode.MOVING


def test_a_new_arm_is_off_without_faults_and_knows_no_zero():
    monitor = Monitor()
    assert (monitor.mode, monitor.faults, monitor.reaction) == (Mode.OFF, (), None)
    assert not monitor.is_homed


def test_homing_again_forgets_the_old_zero_until_it_succeeds():
    monitor = _monitor(Mode.HOLDING)
    assert monitor.is_homed
    monitor.on(Event.HOME)
    assert not monitor.is_homed


def test_a_board_that_lost_its_zero_takes_the_right_to_move():
    monitor = _monitor(Mode.HOLDING)
    monitor.forget_home()
    with pytest.raises(IllegalTransition, match="home"):
        monitor.on(Event.MOVE)


def test_no_step_of_a_shutdown_lets_an_arm_go_that_its_boards_hold():
    assert next_towards_off(Mode.HELD, is_still=True) is None


@pytest.mark.parametrize("mode", [mode for mode in Mode if mode is not Mode.HELD])
@pytest.mark.parametrize("fault", [None, CONTROLLED, BRAKE])
def test_shutdown_reaches_off_from_every_mode_never_off_before_brake_and_brake_only_when_still(mode, fault):
    monitor = _monitor(mode)
    if fault is not None:
        monitor.fault(fault)
    path = []
    for cycle in range(20):
        is_still = cycle % 3 == 2
        event = monitor.next_towards_off(is_still)
        if event is None and monitor.mode is Mode.STOPPING:
            event = Event.STOPPED
        if event is not None:
            if event is Event.SWITCH_OFF or (event is Event.BRAKE and monitor.mode is not Mode.GUIDING):
                assert is_still
            if event is Event.SWITCH_OFF:
                assert monitor.mode is Mode.BRAKED or monitor.reaction is Reaction.BRAKE
            path.append((monitor.mode, event))
            monitor.on(event)
    assert monitor.mode is Mode.OFF
    assert len(path) <= 4


@pytest.mark.parametrize(
    ("mode", "still", "held", "expected"),
    [
        (Mode.MOVING, False, False, Event.STOP),
        (Mode.HOMING, True, False, Event.STOP),
        (Mode.JOGGING, False, False, Event.STOP),
        (Mode.PAUSED, True, False, Event.STOP),
        (Mode.GUIDING, False, False, Event.BRAKE),
        (Mode.STOPPING, True, False, None),
        (Mode.HOLDING, False, False, None),
        (Mode.HOLDING, True, False, Event.BRAKE),
        (Mode.BRAKED, False, False, None),
        (Mode.BRAKED, True, False, Event.SWITCH_OFF),
        (Mode.FAULT, True, True, Event.BRAKE),
        (Mode.FAULT, False, True, None),
        (Mode.FAULT, True, False, Event.SWITCH_OFF),
        (Mode.OFF, True, False, None),
    ],
)
def test_each_step_of_a_shutdown(mode, still, held, expected):
    assert next_towards_off(mode, still, held) is expected
    if held is False:
        assert next_towards_off(mode, still) is expected


def test_every_mode_takes_a_fault_and_stop():
    assert all(TRANSITIONS[(mode, Event.FAULT)] is Mode.FAULT for mode in Mode)
    assert all((mode, Event.STOP) in TRANSITIONS for mode in Mode)


def test_no_mode_but_off_held_braked_and_fault_can_be_switched_off():
    assert {mode for mode in Mode if (mode, Event.SWITCH_OFF) in TRANSITIONS} == {Mode.OFF, Mode.HELD, Mode.BRAKED, Mode.FAULT}


def test_a_fault_reads_as_place_what_happened_and_remedy():
    assert str(BRAKE) == "board enc0: no report for 0.05 s; check its cable"


def test_what_status_prints_of_modes_is_the_whole_table_and_no_other_transition():
    shown, event = {}, Event.STOP
    for line in table_text().splitlines():
        if named := re.match(r"  ([A-Z_]+): ", line):
            event = Event[named[1]]
        for origins, following in (part.split(" → ") for part in line.strip().split("; ") if "→" in line):
            modes = Mode if origins == "all" else [Mode[name] for name in origins.split(", ")]
            shown |= {(mode, event): Mode[following] for mode in modes}
    assert shown == dict(TRANSITIONS)
    assert [mode for mode in Mode if f"  {mode.name:<9} {mode.value}\n" not in table_text()] == []


# ---- the boards hold; doubted zeros

HOLD = Fault("encoder_stale", "board enc0", "no report for 0.05 s", "check its cable", Reaction.HOLD)


@pytest.mark.parametrize("mode", Mode)
def test_the_boards_hold_only_an_arm_that_was_controlled(mode):
    monitor = _monitor(mode)
    monitor.fault(HOLD)
    monitor.fault(HOLD)  # the next cycle finds it again
    assert monitor.reaction is max(Reaction.HOLD, UNCONTROLLED.get(mode, Reaction.CONTROLLED))
    assert not monitor.is_held_fault
    assert monitor.acknowledge()
    assert monitor.mode in (Mode.BRAKED, Mode.OFF)


def test_of_two_faults_the_severer_reaction_wins_in_either_order():
    for order in itertools.permutations((CONTROLLED, HOLD, BRAKE)):
        monitor = _monitor(Mode.MOVING)
        reactions = []
        for fault in order:
            monitor.fault(fault)
            reactions.append(monitor.reaction)
        assert reactions == list(itertools.accumulate((fault.reaction for fault in order), max))


@pytest.mark.parametrize("code", sorted(LOSES_ZERO))
def test_a_count_that_went_wrong_takes_the_zero_until_homing_has_found_it(code):
    monitor = _monitor(Mode.HOLDING)
    monitor.fault(Fault(code, "joint 1", "it is off", "home it", Reaction.BRAKE))
    assert (monitor.is_homed, monitor.is_zero_doubted) == (False, True)
    monitor.acknowledge()
    monitor.on(Event.ENABLE)
    with pytest.raises(IllegalTransition, match="home"):
        monitor.on(Event.MOVE)
    monitor.on(Event.HOME)
    assert monitor.is_zero_doubted
    monitor.on(Event.HOMED)
    assert (monitor.is_homed, monitor.is_zero_doubted) == (True, False)


@pytest.mark.parametrize("code", ["following_error", "drive_silent", "supply"])
def test_other_faults_leave_the_zero(code):
    monitor = _monitor(Mode.HOLDING)
    monitor.fault(Fault(code, "joint 1", "it is off", "mend it", Reaction.BRAKE))
    assert (monitor.is_homed, monitor.is_zero_doubted) == (True, False)


def test_the_faults_that_take_the_zero_are_those_of_the_page():
    rows = [line.split(" | ") for line in (ROOT / "docs" / "safety.md").read_text().splitlines()]
    cells = [row[0] for row in rows if len(row) == 5 and row[3].endswith("zero lost")]
    assert {code for cell in cells for code in cell.split("`")[1::2]} == LOSES_ZERO


def test_a_monitor_begins_at_rest_with_nothing_known_and_nothing_doubted():
    monitor = Monitor()
    assert (monitor.mode, monitor.faults, monitor.reaction) == (Mode.OFF, (), None)
    assert (monitor.is_homed, monitor.is_zero_doubted, monitor.is_at_rest) == (False, False, True)


def test_a_refusal_carries_its_reason_for_programs():
    with pytest.raises(IllegalTransition) as refused:
        _monitor(Mode.HOLDING).acknowledge()
    assert refused.value.why == "there is no fault"
    assert (refused.value.mode, refused.value.event) == (Mode.HOLDING, "ACKNOWLEDGE")
