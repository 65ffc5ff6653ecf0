"""The beat of the loop: absolute deadlines, pauses counted and not made up for."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from control.server.scheduling import PeriodicTimer

PERIOD_S = 0.002


class FakeClock:
    """Time as a test wants it; a wait takes `late_s` longer than asked."""

    def __init__(self) -> None:
        self.time_s = 100.0
        self.late_s = 0.0
        self.waits = 0

    def now_s(self) -> float:
        return self.time_s

    def wait_until_s(self, t: float) -> None:
        self.waits += 1
        self.time_s = max(self.time_s, t + self.late_s)


@pytest.fixture
def clock() -> FakeClock:
    return FakeClock()


def test_lateness_does_not_add_up(clock: FakeClock) -> None:
    beat = PeriodicTimer(clock, PERIOD_S)
    clock.late_s = 0.0007
    for _ in range(1000):
        assert beat.wait() == pytest.approx(0.0007, abs=1e-9)
    assert clock.time_s == pytest.approx(100.0 + 1000 * PERIOD_S + 0.0007)
    assert beat.missed == 0


def test_after_a_pause_the_missed_deadlines_are_counted_and_there_is_no_burst(clock: FakeClock) -> None:
    beat = PeriodicTimer(clock, PERIOD_S)
    beat.wait()
    clock.time_s += 20.5 * PERIOD_S
    late_s = beat.wait()
    assert late_s == pytest.approx(19.5 * PERIOD_S)
    assert (beat.skipped, beat.missed, beat.missed_in_row) == (19, 19, 19)
    begun_s = clock.time_s
    assert beat.wait() == pytest.approx(0.0, abs=1e-9)
    assert clock.time_s - begun_s == pytest.approx(0.5 * PERIOD_S)  # on the old grid, not at once
    assert (beat.skipped, beat.missed, beat.missed_in_row) == (0, 19, 0)


@pytest.mark.parametrize(("periods", "skipped"), [(0.999, 0), (1.001, 1), (1.49, 1), (1.51, 2), (2.001, 2)])
def test_a_deadline_is_missed_when_the_next_one_has_come_too_or_comes_within_half_a_period(
    clock: FakeClock, periods: float, skipped: int
) -> None:
    beat = PeriodicTimer(clock, PERIOD_S)
    clock.late_s = periods * PERIOD_S
    beat.wait()
    assert beat.skipped == skipped
    begun_s, clock.late_s = clock.time_s, 0.0
    beat.wait()
    assert clock.time_s - begun_s >= 0.5 * PERIOD_S or skipped == 0


def test_missed_in_a_row_grows_while_every_cycle_is_late_and_ends_with_one_in_time(clock: FakeClock) -> None:
    beat = PeriodicTimer(clock, PERIOD_S)
    clock.late_s = 1.5 * PERIOD_S
    for cycle in range(1, 6):
        beat.wait()
        assert beat.missed_in_row == cycle
    clock.late_s = 0.0
    beat.wait()
    beat.wait()
    assert (beat.missed_in_row, beat.missed) == (0, 5)


def test_a_restart_forgives_what_was_waited_outside_of_a_cycle(clock: FakeClock) -> None:
    beat = PeriodicTimer(clock, PERIOD_S)
    beat.wait()
    clock.time_s += 0.3
    beat.restart()
    begun_s = clock.time_s
    assert beat.wait() == 0.0
    assert clock.time_s - begun_s == pytest.approx(PERIOD_S)
    assert beat.missed == 0


@settings(deadline=None)
@given(st.lists(st.floats(0.0, 0.2), min_size=1, max_size=50))
def test_every_deadline_is_either_served_or_counted_as_missed(pauses_s: list[float]) -> None:
    clock = FakeClock()
    beat = PeriodicTimer(clock, PERIOD_S)
    for pause_s in pauses_s:
        clock.time_s += pause_s
        assert beat.wait() >= 0.0
    passed = (clock.time_s - 100.0) / PERIOD_S
    assert abs(len(pauses_s) + beat.missed - passed) < 1.0 + 1e-6
