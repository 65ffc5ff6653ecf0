"""What is wanted of the drives by mode and way, and what the boards say against it."""

from __future__ import annotations

import pytest

from control.hardware.interface import Feedback, Wanted
from control.loop.drives import Bound, DriveStates, drives_wanted
from control.safety.modes import Mode, Reaction

ENABLED, SWITCHED_ON, LIMITING, OFF = 0x27, 0x23, 0xA7, 0x40  # of docs/motor_board.md; bit 7 is a warning
TO_HOLD = (Bound.ON, Bound.HOLD)


def states(*words: int) -> Feedback:
    feedback = Feedback(len(words))
    feedback.statusword = list(words)
    feedback.has_torque = [word & 0x7F == ENABLED for word in words]
    return feedback


@pytest.mark.parametrize("bound", list(Bound))
@pytest.mark.parametrize("before", list(Wanted))
def test_off_never_wants_a_drive_on_whatever_was_asked(bound: Bound, before: Wanted) -> None:
    assert drives_wanted(Mode.OFF, bound, before) is Wanted.DISABLED


@pytest.mark.parametrize("mode", [mode for mode in Mode if mode is not Mode.OFF])
@pytest.mark.parametrize("bound", list(Bound))
@pytest.mark.parametrize("before", list(Wanted))
def test_only_the_way_to_hold_enables_and_a_fault_ends_it(mode: Mode, bound: Bound, before: Wanted) -> None:
    assert drives_wanted(Mode.FAULT, bound, Wanted.ENABLING, True) is Wanted.ENABLING  # but no take-over
    wanted = drives_wanted(mode, bound, before)
    if mode in (Mode.FAULT, Mode.HELD) and not before.is_on:
        assert wanted is before
    elif mode is Mode.HELD:
        assert wanted is Wanted.ENABLING  # a take-over that has begun goes to its end
    else:
        assert (wanted is Wanted.ENABLING) is (bound in TO_HOLD and mode is not Mode.FAULT)
        assert wanted in (Wanted.ENABLING, Wanted.ENABLED)


def test_drives_are_ready_once_all_are_enabled_and_stay_so_until_they_are_doubted() -> None:
    drives = DriveStates(("joint 1", "joint 2"))
    assert drives.follow(0.0, states(ENABLED, ENABLED)) == []
    assert not drives.is_ready  # nobody asked
    assert not drives.is_taken_over
    drives.want(8.0, Wanted.ENABLING)
    assert drives.follow(8.5, states(ENABLED, SWITCHED_ON)) == []
    assert not drives.is_ready
    assert drives.follow(8.75, states(ENABLED, LIMITING)) == []
    assert drives.is_ready
    assert drives.want(8.75, Wanted.ENABLING) is Wanted.ENABLED  # it is done
    assert drives.follow(99.0, states(SWITCHED_ON, SWITCHED_ON)) == []  # from now on the watch looks
    assert drives.is_ready
    drives.doubt()
    assert drives.follow(100.0, states(ENABLED, OFF)) == []
    assert not drives.is_ready
    drives.want(100.0, Wanted.DISABLED)
    drives.follow(100.0, states(ENABLED, ENABLED))
    assert not drives.is_ready


def test_a_drive_that_is_not_enabled_within_a_second_is_a_fault() -> None:
    drives = DriveStates(("joint 1", "joint 2", "joint 3"))
    drives.want(8.0, Wanted.ENABLING)
    late = states(SWITCHED_ON, ENABLED, 0x08)
    assert drives.follow(9.0, late) == []
    faults = drives.follow(9.0 + 2**-40, late)
    assert [(fault.code, fault.where, fault.reaction) for fault in faults] == [
        ("drive_not_enabled", "joint 1", Reaction.HOLD),
        ("drive_not_enabled", "joint 3", Reaction.HOLD),
    ]
    assert "within 1.0 s (statusword 0x08)" in faults[1].message
    drives.want(9.1, Wanted.ENABLED)  # as in FAULT
    assert drives.follow(99.0, late) == []


def test_a_fault_of_a_drive_on_its_way_on_is_told_at_once_and_by_its_name() -> None:
    drives = DriveStates(("joint 1", "joint 2"))
    drives.want(8.0, Wanted.ENABLING)
    hot = states(SWITCHED_ON, 0x08)
    hot.drive_faults = [0, 0x02]
    for now_s in (8.0, 9.5):
        faults = [(fault.code, fault.where, fault.reaction) for fault in drives.follow(now_s, hot)]
        assert faults[-1] == ("drive_fault", "joint 2", Reaction.HOLD)
        assert len(faults) == (1 if now_s == 8.0 else 2)


def test_a_take_over_goes_on_until_all_are_in_operation_or_late() -> None:
    drives = DriveStates(("joint 1", "joint 2"))
    drives.take_over(8.0)
    drives.follow(9.0, states(ENABLED, SWITCHED_ON))
    assert drives.is_taken_over
    drives.follow(9.0 + 2**-40, states(ENABLED, SWITCHED_ON))
    assert not drives.is_taken_over
    drives.take_over(9.5)
    drives.follow(9.6, states(ENABLED, ENABLED))
    assert drives.want(9.6, Wanted.ENABLING) is Wanted.ENABLED
    assert not drives.is_taken_over


def test_a_drive_that_stays_enabled_for_a_second_in_off_is_a_fault_and_one_that_lets_go_is_none() -> None:
    drives = DriveStates(("joint 1", "joint 2"))
    drives.want(8.0, Wanted.DISABLED)
    for now_s in (8.0, 8.5, 9.0):
        assert drives.follow(now_s, states(OFF, ENABLED)) == []
    assert [(fault.code, fault.where) for fault in drives.follow(9.25, states(OFF, ENABLED))] == [
        ("drive_not_disabled", "joint 2")
    ]
    assert drives.follow(9.5, states(ENABLED, OFF)) == []
    assert drives.follow(10.5, states(ENABLED, ENABLED)) == []
    assert drives.follow(10.75, states(OFF, ENABLED)) == []


def test_a_board_that_holds_after_a_time_out_has_torque_whatever_its_state_is_called() -> None:
    drives = DriveStates(("joint 1",))
    drives.want(0.0, Wanted.DISABLED)
    holding = states(0x08)
    holding.has_torque = [True]
    assert drives.follow(0.0, holding) == []
    assert [fault.code for fault in drives.follow(1.5, holding)] == ["drive_not_disabled"]


def test_torque_of_an_earlier_off_does_not_make_a_later_one_late() -> None:
    drives = DriveStates(("joint 1",))
    drives.want(0.0, Wanted.DISABLED)
    assert drives.follow(0.0, states(ENABLED)) == []
    drives.want(0.5, Wanted.ENABLING)
    assert drives.follow(0.5, states(ENABLED)) == []
    drives.want(60.0, Wanted.DISABLED)
    assert drives.follow(60.0, states(ENABLED)) == []
    assert [fault.code for fault in drives.follow(61.5, states(ENABLED))] == ["drive_not_disabled"]


def test_a_way_leads_to_hold_or_off() -> None:
    assert {bound for bound in Bound if bound.is_hold} == {Bound.ON, Bound.HOLD}
    assert {bound for bound in Bound if bound.is_off} == {Bound.OFF, Bound.QUIT}


def test_drives_that_were_ready_are_not_once_they_are_wanted_off_or_on_anew() -> None:
    drives = DriveStates(("joint 1", "joint 2"))
    drives.want(0.0, Wanted.ENABLING)
    drives.follow(0.0, states(ENABLED, ENABLED))
    assert drives.out_of_operation(states(OFF, OFF)) == []
    drives.want(1.0, Wanted.DISABLED)
    assert not drives.is_ready
    drives.want(2.0, Wanted.ENABLED)
    assert not drives.is_ready
    assert drives.out_of_operation(states(ENABLED, OFF)) == ["joint 2"]
    drives.want(3.0, Wanted.DISABLED)
    assert drives.out_of_operation(states(OFF, OFF)) == []
    drives.follow(3.0, states(ENABLED, OFF))
    assert [fault.reaction for fault in drives.follow(4.5, states(ENABLED, OFF))] == [Reaction.BRAKE]
