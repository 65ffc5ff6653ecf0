"""The loop's phase against the reports of a board: a line with its own clock, jitter and losses, and a host that is late."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field

import pytest

from control.server.process import BOUND, EARLIER, SILENT, VAIN, PhaseFollower
from control.server.scheduling import PeriodicTimer
from tests.firmware_iface.scripted import FakeClock

PERIOD_s = 0.002
WAY_s = 0.00025  # of a report that nothing delays
AWAKE_s = 3e-5  # the host is that late at best


@dataclass
class Line:
    """Reports every `report_s` of the board's clock, which is `fast` by the host's; some are late, some are lost."""

    fast: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    report_s: float = 0.001
    stall: float = 0.0  # share of the reports that come 1 ms later
    silent_s: tuple[float, float] = (math.inf, math.inf)
    is_frozen: bool = False
    clock: FakeClock = field(default_factory=lambda: FakeClock(0.0))
    random: random.Random = field(default_factory=lambda: random.Random(3))
    newest_s: float = math.nan  # on the board's clock
    made_s: float = 0.0  # the same on the host's
    way_s: float = 0.0  # how much longer than WAY_s the newest was under way
    awaited: int = 0
    _number: int = 0
    _under_way: list[tuple[float, int]] = field(default_factory=list)

    def made(self, number: int) -> float:
        return 0.00037 + number * self.report_s / (1.0 + self.fast)

    def _make(self, until_s: float) -> None:
        while (made_s := self.made(self._number)) <= until_s:
            delay_s = abs(self.random.gauss(0.0, self.jitter_s))
            delay_s += 1e-3 if self.random.random() < self.stall else 0.0
            is_silent = self.silent_s[0] < made_s < self.silent_s[1]
            if self.random.random() >= self.loss and not is_silent:
                self._under_way.append((made_s + WAY_s + delay_s, self._number))
            self._number += 1

    def _read(self) -> None:
        now_s = self.clock.now_s()
        for at_s, number in sorted(self._under_way):
            if at_s <= now_s and not number * self.report_s <= self.newest_s and not self.is_frozen:
                self.newest_s, self.made_s = number * self.report_s, self.made(number)
                self.way_s = at_s - self.made_s - WAY_s
        self._under_way = [report for report in self._under_way if report[0] > now_s]

    def await_counts(self, made_s: float, until_s: float) -> float:
        clock = self.clock
        self._make(max(clock.now_s(), until_s))
        self._read()
        self.awaited += until_s > clock.now_s()
        while not self.newest_s >= made_s and clock.now_s() < until_s:
            next_s = min((at_s for at_s, _ in self._under_way), default=math.inf)
            clock.wait_until_s(min(next_s, until_s))
            self._read()
        return self.newest_s


@dataclass
class Cycles:
    """What came of it, cycle by cycle [s]: ages beyond WAY_s, the wait for the report, and the next period's change."""

    ages_s: list[float] = field(default_factory=list)
    waits_s: list[float] = field(default_factory=list)
    trims_s: list[float] = field(default_factory=list)
    skipped: int = 0

    def age_s(self, share: float) -> float:
        settled = sorted(self.ages_s[len(self.ages_s) // 2 :])
        return settled[int(share * len(settled))]


def run(line: Line, seconds: float = 20.0, late_s: float = 0.0, follows: bool = True) -> Cycles:
    """Cycles of the loop; the host is late by up to `late_s` beside AWAKE_s."""
    clock, source, cycles = line.clock, random.Random(5), Cycles()
    beat, follower = PeriodicTimer(clock, PERIOD_s), PhaseFollower(line.await_counts, clock, PERIOD_s)
    while clock.now_s() < seconds:
        late_at_s = beat.wait()
        deadline_s = clock.now_s() - late_at_s
        clock.time_s += AWAKE_s + source.random() * late_s
        begun_s = clock.now_s()
        if follows:
            beat.trim_s = follower.wait(deadline_s, beat.skipped)
        else:
            line.await_counts(-math.inf, -math.inf)
        cycles.ages_s.append(clock.now_s() - line.made_s - WAY_s)
        cycles.waits_s.append(clock.now_s() - max(begun_s, deadline_s))
        cycles.trims_s.append(beat.trim_s)
        cycles.skipped += beat.skipped
    return cycles


@pytest.mark.parametrize("report_s", [0.001, 0.002])
@pytest.mark.parametrize("fast", [-3e-4, 1e-4, 3e-4])
@pytest.mark.parametrize("jitter_s", [0.0, 5e-5])
def test_counts_are_fresh_when_a_cycle_begins_whatever_their_clock_and_jitter(
    report_s: float, fast: float, jitter_s: float
) -> None:
    followed = run(Line(fast, jitter_s, report_s=report_s))
    assert followed.age_s(0.5) < AWAKE_s + 2.0 * jitter_s
    assert followed.age_s(0.99) < 2.5e-4
    assert followed.skipped == 0
    free = run(Line(fast, jitter_s, report_s=report_s), follows=False)
    assert free.age_s(0.9) > 2.9e-4, "without it the phase is what it happens to be, and drifts"


def test_lost_and_stalled_reports_do_not_make_the_others_old() -> None:
    assert run(Line(1e-4, 2e-5, loss=0.05)).age_s(0.9) < 1e-4
    assert run(Line(1e-4, 2e-5, stall=0.05)).age_s(0.9) < 1e-4


def test_a_host_that_is_late_by_a_tenth_of_a_period_does_not_drive_the_phase_away() -> None:
    assert run(Line(1e-4, 1e-5), late_s=2e-4).age_s(0.98) < 3e-4


def test_on_a_busy_host_few_cycles_wait_in_vain_although_reports_spread_wider_than_the_wait() -> None:
    assert run(Line(1e-4, jitter_s=2e-4)).age_s(0.9) < 5e-4


@pytest.mark.parametrize(
    "line",
    [
        Line(),
        Line(jitter_s=5e-4),
        Line(loss=0.5),
        Line(stall=0.5),
        Line(5e-3),
        Line(loss=1.0),
        Line(is_frozen=True),
        Line(silent_s=(3.0, 3.2)),
    ],
    ids=["even", "uneven", "half lost", "half late", "fast", "silent", "frozen", "interrupted"],
)
def test_whatever_the_line_does_no_cycle_waits_beyond_its_bound_and_the_phase_never_jumps(line: Line) -> None:
    cycles = run(line, 6.0)
    assert max(cycles.waits_s) <= BOUND * PERIOD_s
    assert min(cycles.trims_s) >= -EARLIER * PERIOD_s
    assert max(cycles.trims_s) <= VAIN * PERIOD_s
    assert cycles.skipped == 0


def test_a_silent_board_is_soon_not_waited_for_and_one_that_comes_back_is_followed_again() -> None:
    line = Line(1e-4, silent_s=(10.0, 12.0))
    assert run(line, 10.0).age_s(0.99) < 1e-4
    line.awaited = 0
    silent = run(line, 11.5)
    assert line.awaited <= SILENT + 1
    assert silent.trims_s[-1] == 0.0, "nobody knows which way to go"
    assert run(line, 15.0).age_s(0.99) < 1e-4


class Told:
    """A follower of a board whose newest counts were made when the test says; nothing comes while it waits."""

    def __init__(self) -> None:
        self.clock, self.newest_s = FakeClock(0.0), math.nan
        self.follower = PhaseFollower(lambda made_s, until_s: self.newest_s, self.clock, PERIOD_s)

    def way(self, newest_s: float, skipped: int = 0, late_s: float = 0.0) -> float:
        """1: the phase goes as much earlier as it can, -1: later, 0: it stays."""
        self.newest_s = newest_s
        trim_s = self.follower.wait(self.clock.now_s() - late_s, skipped)
        return {-EARLIER * PERIOD_s: 1, VAIN * PERIOD_s: -1}.get(trim_s, trim_s)


def test_a_board_that_restarted_is_followed_by_its_new_time() -> None:
    told = Told()
    assert [told.way(newest_s) for newest_s in (10.0, 10.002, 0.001, 0.003)] == [1, 1, 0, 1]


def test_after_missed_deadlines_the_report_of_now_is_meant() -> None:
    told = Told()
    assert [told.way(10.0), told.way(10.005, skipped=2), told.way(10.008)] == [1, -1, 1]


def test_a_cycle_that_begins_after_its_bound_tells_nothing_about_the_phase() -> None:
    told = Told()
    assert [told.way(10.0), told.way(10.002, late_s=1.01 * BOUND * PERIOD_s), told.way(10.004)] == [1, 0, 1]


def test_without_a_stream_there_is_nothing_to_follow() -> None:
    clock = FakeClock(0.0)
    follower = PhaseFollower(lambda made_s, until_s: math.nan, clock, PERIOD_s)
    assert [follower.wait(clock.now_s(), number) for number in (0, 0, 1, 3)] == [0.0] * 4
