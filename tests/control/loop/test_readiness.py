"""Drives on their way to OPERATION ENABLED: ready together, and each that is not there in time is named."""

from __future__ import annotations

import pytest

from control.hardware.interface import Feedback
from control.loop.readiness import DriveReadiness, is_any_enabled
from control.safety.fault import Reaction

ENABLED, SWITCHED_ON, LIMITING = 0x27, 0x23, 0xA7  # of docs/motor_board.md; bit 7 is a warning


def states(*words: int) -> Feedback:
    feedback = Feedback(len(words))
    feedback.statusword = list(words)
    return feedback


def test_drives_are_ready_once_all_are_enabled() -> None:
    drives = DriveReadiness(("joint 1", "joint 2"))
    assert drives.follow(0.0, states(ENABLED, ENABLED)) == []
    assert (drives.is_ready, drives.is_awaited) == (False, False)  # nobody asked
    drives.expect(8.0)
    assert drives.is_awaited
    assert drives.follow(8.5, states(ENABLED, SWITCHED_ON)) == []
    assert (drives.is_ready, drives.is_awaited) == (False, True)
    assert drives.follow(8.75, states(ENABLED, LIMITING)) == []
    assert (drives.is_ready, drives.is_awaited) == (True, False)
    assert drives.follow(99.0, states(SWITCHED_ON, SWITCHED_ON)) == []  # from now on the watch looks
    drives.expect(100.0)
    assert (drives.is_ready, drives.is_awaited) == (False, True)
    drives.follow(100.0, states(ENABLED, ENABLED))
    drives.forget()
    assert (drives.is_ready, drives.is_awaited) == (False, False)


def test_a_drive_that_is_not_enabled_within_a_second_is_a_fault_once() -> None:
    drives = DriveReadiness(("joint 1", "joint 2", "joint 3"))
    drives.expect(8.0)
    late = states(SWITCHED_ON, ENABLED, 0x08)
    late.drive_faults = [0, 0, 0x80]
    assert drives.follow(9.0, late) == []
    faults = drives.follow(9.0 + 2**-40, late)
    assert [(fault.code, fault.where, fault.reaction) for fault in faults] == [
        ("drive_not_enabled", "joint 1", Reaction.BRAKE), ("drive_not_enabled", "joint 3", Reaction.BRAKE),
    ]  # fmt: skip
    assert "within 1.0 s (statusword 0x08, fault bits 0x80)" in faults[1].message
    assert drives.follow(99.0, late) == []
    assert not drives.is_awaited


@pytest.mark.parametrize(("words", "is_any"), [((SWITCHED_ON, ENABLED), True), ((SWITCHED_ON, 0), False)])
def test_one_enabled_drive_is_enough_to_be_careful(words: tuple[int, int], is_any: bool) -> None:
    assert is_any_enabled(states(*words)) is is_any
