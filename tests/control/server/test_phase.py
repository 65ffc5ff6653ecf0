"""The loop's phase against the reports of a board: a line with its own clock, jitter and losses, and a host that is late."""

from __future__ import annotations

import random
from dataclasses import dataclass, field

import pytest

from control.server.phase import MOST, PhaseFollower, STEP_s

PERIOD_s, REPORT_s = 0.002, 0.001


@dataclass
class Line:
    """Reports every millisecond of the board's clock, `fast` of the host's; some are lost."""

    fast: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    random: random.Random = field(default_factory=lambda: random.Random(3))
    reports: int = 0
    lost: int = 0
    newest_s: float = 0.0
    _number: int = 0
    _next: int = 0
    _under_way: list[tuple[float, float, int]] = field(default_factory=list)

    def read(self, now_s: float) -> None:
        """All that has arrived by now: how many so far, and when the newest was made."""
        while (made_s := 0.00037 + self._number * REPORT_s / (1.0 + self.fast)) <= now_s:
            self._number += 1
            if self.random.random() >= self.loss:
                self._under_way.append(
                    (made_s + abs(self.random.gauss(0.0, self.jitter_s)), made_s, self._number)
                )
        for at_s, made_s, number in sorted(self._under_way):
            if at_s <= now_s:
                self.reports += 1
                self.lost += max(0, number - self._next - 1)  # as the sequence tells
                self._next, self.newest_s = number, made_s
        self._under_way = [report for report in self._under_way if report[0] > now_s]


def run(
    line: Line, seconds: float, late_s: float = 0.0, follows: bool = True
) -> tuple[list[float], list[float]]:
    """Ages of the newest counts when each cycle began, and all periods [s]."""
    follower = PhaseFollower(2 if follows else 0, PERIOD_s)
    source, deadline_s, ages_s, periods_s = random.Random(5), 0.0, [], []
    for _ in range(round(seconds / PERIOD_s)):
        line.read(deadline_s + source.random() * late_s)
        ages_s.append(deadline_s - line.newest_s)
        periods_s.append(PERIOD_s + follower.trim_s(line.reports, line.lost, has_missed=False))
        deadline_s += periods_s[-1]
    return ages_s, periods_s


def quantile(values: list[float], share: float) -> float:
    return sorted(values)[int(share * len(values))]


@pytest.mark.parametrize("fast", [-1e-4, 0.0, 3e-4])
@pytest.mark.parametrize("jitter_s", [0.0, 2e-5])
def test_counts_are_younger_than_three_tenths_of_a_millisecond(fast: float, jitter_s: float) -> None:
    ages_s, _ = run(Line(fast, jitter_s), 30.0)
    settled = ages_s[len(ages_s) // 2 :]
    assert quantile(settled, 0.5) < 1.5e-4
    assert quantile(settled, 0.98) < 3e-4
    free, _ = run(Line(fast, jitter_s), 30.0, follows=False)
    assert quantile(free, 0.98) > 3.5e-4, "without it the phase is what it happens to be, and drifts"


def test_lost_reports_are_no_reason_to_wait_for_later_ones() -> None:
    ages_s, _ = run(Line(1e-4, 1e-5, loss=0.05), 30.0)
    assert quantile(ages_s[len(ages_s) // 2 :], 0.9) < 3e-4


def test_a_host_that_is_late_by_a_tenth_of_a_period_does_not_drive_the_phase_away() -> None:
    ages_s, _ = run(Line(1e-4, 1e-5), 30.0, late_s=2e-4)
    assert quantile(ages_s[len(ages_s) // 2 :], 0.98) < 3e-4


@pytest.mark.parametrize(
    "line",
    [Line(), Line(jitter_s=5e-4), Line(loss=0.5), Line(5e-3), Line(loss=1.0)],
    ids=["even", "uneven", "half lost", "fast", "silent"],
)
def test_whatever_the_line_does_no_period_is_shorter_by_more_than_a_microsecond(line: Line) -> None:
    _, periods_s = run(line, 10.0)
    assert min(periods_s) >= PERIOD_s * (1.0 - MOST) - 1e-12
    assert max(periods_s) <= PERIOD_s + STEP_s + 1e-12


def trims(counts: list[tuple[int, int]]) -> list[bool]:
    """For each cycle's (reports, lost): whether it was followed by a step back."""
    follower, reports, lost, steps = PhaseFollower(2, PERIOD_s), 0, 0, []
    for came, missing in counts:
        reports, lost = reports + came, lost + missing
        steps.append(follower.trim_s(reports, lost, has_missed=came > 9) == STEP_s)
    return steps


@pytest.mark.parametrize(
    ("what", "counts", "is_step"),
    [
        ("too early, and so are the next ones", [(2, 0), (1, 0), (2, 0)], True),
        ("too early by jitter", [(2, 0), (1, 0), (3, 0)], True),
        ("the last one was lost", [(2, 0), (1, 0), (2, 1)], False),
        ("the first one was lost", [(2, 0), (1, 1), (2, 0)], False),
        ("the cycle before was late", [(3, 0), (1, 0), (2, 0)], False),
        ("deadlines were missed", [(2, 0), (1, 0), (40, 0), (3, 0)], False),
    ],
)
def test_only_a_report_that_was_not_there_yet_is_a_reason_to_step_back(
    what: str, counts: list[tuple[int, int]], is_step: bool
) -> None:
    assert any(trims(counts)) is is_step, what


def test_without_a_stream_there_is_nothing_to_follow() -> None:
    follower = PhaseFollower(0, PERIOD_s)
    assert [follower.trim_s(number, 0, has_missed=False) for number in (0, 0, 1, 3)] == [0.0] * 4
