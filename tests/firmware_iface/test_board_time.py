"""Board time: wraps, pauses and restarts are told apart."""

import pytest

from firmware_iface.encoder.board import BoardTime

WRAP_s = 2**32 / 1e6


def test_time_goes_on_over_the_wrap() -> None:
    time = BoardTime()
    for step in range(10):
        microseconds = 2**32 - 5000 + step * 1000
        assert time.advance(microseconds % 2**32, step * 0.001)
    assert time.seconds == pytest.approx(WRAP_s + 0.004)


@pytest.mark.parametrize("pause_s", [0.0, 1.0, 60.0, 3000.0, WRAP_s + 10.0, 3 * WRAP_s + 100.0])
def test_a_pause_of_any_length_is_no_restart(pause_s: float) -> None:
    time = BoardTime()
    time.advance(1_000_000, 50.0)
    assert time.advance(int((1.0 + pause_s) * 1e6) % 2**32, 50.0 + pause_s)
    assert time.seconds == pytest.approx(1.0 + pause_s)


def test_reports_that_waited_in_a_buffer_are_no_restart() -> None:
    time = BoardTime()
    time.advance(0, 0.0)
    # The host stands still for 10 s: the first 0.3 s are in the buffer, the rest was dropped.
    for number in range(1, 150):
        assert time.advance(number * 2000, 10.0)
    assert time.advance(10_000_000, 10.002)
    assert time.seconds == pytest.approx(10.0)


def test_first_reports_that_waited_for_a_host_that_was_busy_with_its_start_are_no_restart() -> None:
    time = BoardTime()
    for number in range(150):
        assert time.advance(number * 1000, 50.0)  # the oldest, read 3 s late
    assert time.advance(3_010_000, 50.01)  # a tty that was full has dropped those between
    assert time.advance(3_011_000, 50.011)


@pytest.mark.parametrize("ran_s", [1.0, 100.0, 2500.0, 3000.0, WRAP_s + 3000.0])
@pytest.mark.parametrize("off_s", [0.1, 0.5, 5.0])
def test_a_restart_is_told_however_long_it_ran(ran_s: float, off_s: float) -> None:
    time = BoardTime()
    for tenth in range(11):
        assert time.advance(int(ran_s * tenth * 1e5) % 2**32, ran_s * tenth / 10)
    assert not time.advance(50_000, ran_s + off_s)
    assert time.advance(52_000, ran_s + off_s + 0.002)
    assert time.seconds == pytest.approx(0.052)


def test_drift_of_the_crystals_is_no_restart() -> None:
    for drift in (-2e-4, 2e-4):
        time = BoardTime()
        for minute in range(3000):
            assert time.advance(int(minute * 60e6 * (1 + drift)) % 2**32, minute * 60.0)
