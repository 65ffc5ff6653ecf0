"""One error for a connection that failed, and the machine's clock."""

import pytest

from firmware_iface.clock import MonotonicClock
from firmware_iface.errors import (
    MOST_PROBLEMS,
    BoardReset,
    BoardSilent,
    ConnectionFailed,
    PortMissing,
    Problems,
    ProtocolViolation,
    connect_all,
)


def fail(problem: Exception) -> str:
    raise problem


def test_one_connection_error_names_every_device_that_failed() -> None:
    steps = [lambda: "enc0", lambda: fail(BoardSilent("motor board 2: x")), lambda: fail(PortMissing("can0: y"))]
    with pytest.raises(ConnectionFailed) as caught:
        connect_all(steps)
    assert str(caught.value) == "cannot connect:\n  - motor board 2: x\n  - can0: y"
    assert [type(failure) for failure in caught.value.failures] == [BoardSilent, PortMissing]


def test_all_devices_are_tried_and_their_results_returned() -> None:
    assert connect_all([lambda: 1, lambda: 2]) == [1, 2]


def test_an_error_that_is_not_the_links_comes_through() -> None:
    with pytest.raises(ZeroDivisionError):
        connect_all([lambda: fail(ZeroDivisionError())])


def test_a_violation_carries_the_bytes() -> None:
    violation = ProtocolViolation("board x: odd", b"\x01\xff")
    assert str(violation) == "board x: odd (received: 01 ff)"
    assert violation.received == b"\x01\xff"


def test_a_board_that_babbles_fills_no_memory_and_hides_no_restart() -> None:
    problems = Problems()
    for k in range(1000):
        problems.append(ProtocolViolation("board x: odd", bytes([k % 256])))
        problems.append(BoardSilent("board y: silent"))
    problems.append(BoardReset("board z: restarted"))
    assert len(problems) == MOST_PROBLEMS + 1
    assert [str(known) for known in problems].count("board y: silent") == 1
    assert isinstance(problems[-1], BoardReset)


def test_the_clock_waits_until_an_absolute_time_and_not_for_one_that_has_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [5.0]
    slept = []

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        now[0] += max(0.25, seconds / 2)  # sleeps may end early

    monkeypatch.setattr("firmware_iface.clock.time.monotonic", lambda: now[0])
    monkeypatch.setattr("firmware_iface.clock.time.sleep", sleep)
    clock = MonotonicClock()
    clock.wait_until_s(6.0)
    assert clock.now_s() >= 6.0
    assert slept[0] == 1.0
    slept.clear()
    clock.wait_until_s(5.5)
    assert slept == []
