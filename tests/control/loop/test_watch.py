"""What is wrong in a cycle is found at its limit and not below it, by the quick look and by the thorough one alike."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, field
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from control.hardware.interface import Feedback
from control.loop.watch import (
    DRIVE_FAULTS,
    OPERATION_ENABLED,
    QUADRATURE_ERROR,
    SIGNAL_LOST,
    ZERO_SET,
    Expectation,
    MeasuredLimits,
    Watch,
    WatchLimits,
)
from control.motion.setpoint import SetPoint
from control.safety.limits import NotFinite
from control.safety.modes import Fault, Reaction

# Powers of two, so that values at a limit are at the limit and not a rounding beside it.
LIMIT = MeasuredLimits(
    lower_rad=-1.0,
    upper_rad=2.0,
    range_margin_rad=0.0625,
    speed_rad_s=4.0,
    following_error_rad=0.0625,
    following_error_per_speed_s=0.125,
)
LIMITS = WatchLimits((LIMIT, LIMIT), stale_s=0.03125, silent_s=0.25, missed_in_row=10)
NOW_S = 64.0
TINY = 2.0**-30


@dataclass
class Cycle:
    """A cycle in which all is well, to be changed."""

    now_s: float = NOW_S
    encoder_at_s: float = NOW_S
    reported_at_s: list[float] = field(default_factory=lambda: [NOW_S, NOW_S])
    reply_at_s: list[float] = field(default_factory=lambda: [NOW_S, NOW_S])
    channel_flags: list[int] = field(default_factory=lambda: [ZERO_SET, ZERO_SET])
    statusword: list[int] = field(default_factory=lambda: [0x37, 0x37])
    drive_faults: list[int] = field(default_factory=lambda: [0, 0])
    q_rad: list[float] = field(default_factory=lambda: [0.5, 0.5])
    speed_rad_s: list[float] = field(default_factory=lambda: [0.0, 0.0])
    q_set_rad: list[float] = field(default_factory=lambda: [0.5, 0.5])
    speed_set_rad_s: list[float] = field(default_factory=lambda: [0.0, 0.0])
    missed_in_row: int = 0
    expected: Expectation = field(default_factory=lambda: Expectation(True, True, True))

    def faults(self, watch: Watch | None = None) -> list[Fault]:
        feedback = Feedback(2)
        for name in ("encoder_at_s", "reported_at_s", "reply_at_s", "channel_flags", "statusword", "drive_faults"):
            setattr(feedback, name, getattr(self, name))
        return (watch or Watch(LIMITS, ("joint 1", "joint 2"))).look(
            self.now_s,
            feedback,
            SetPoint(tuple(self.q_rad), tuple(self.speed_rad_s), ()),
            SetPoint(tuple(self.q_set_rad), tuple(self.speed_set_rad_s), ()),
            self.missed_in_row,
            self.expected,
        )

    def codes(self, watch: Watch | None = None) -> list[tuple[str, str]]:
        return [(fault.code, fault.where) for fault in self.faults(watch)]


def changed(**values: Any) -> Cycle:
    return Cycle(**values)


def second(good: Any, bad: Any) -> list[Any]:
    """Values of both joints of which the second is the one to look at."""
    return [good, bad]


def test_when_all_is_well_nothing_is_found() -> None:
    assert Cycle().faults() == []


AT_AND_BEYOND: list[tuple[str, str, dict[str, Any], dict[str, Any]]] = [
    ("encoder_stale", "encoder board", {"encoder_at_s": NOW_S - 0.03125}, {"encoder_at_s": NOW_S - 0.03125 - TINY}),
    ("drive_silent", "joint 2", {"reply_at_s": [NOW_S, NOW_S - 0.03125]}, {"reply_at_s": [NOW_S, NOW_S - 0.03125 - TINY]}),
    ("overspeed", "joint 2", {"speed_rad_s": [0.0, 4.0]}, {"speed_rad_s": [0.0, 4.0 + TINY]}),
    ("overspeed", "joint 2", {"speed_rad_s": [0.0, -4.0]}, {"speed_rad_s": [0.0, -4.0 - TINY]}),
    ("following_error", "joint 2", {"q_rad": [0.5, 0.5625]}, {"q_rad": [0.5, 0.5625 + TINY]}),
    ("following_error", "joint 2", {"q_rad": [0.5, 0.4375]}, {"q_rad": [0.5, 0.4375 - TINY]}),
    (
        "following_error",
        "joint 2",
        {"q_rad": [0.5, 0.5 + 0.1875], "speed_set_rad_s": [0.0, -1.0]},
        {"q_rad": [0.5, 0.5 + 0.1875 + TINY], "speed_set_rad_s": [0.0, -1.0]},
    ),
    (
        "joint_range",
        "joint 2",
        {"q_rad": [0.5, 2.0625], "q_set_rad": [0.5, 2.0]},
        {"q_rad": [0.5, 2.0625 + TINY], "q_set_rad": [0.5, 2.0 - 0.0], "speed_set_rad_s": [0.0, 1.0]},
    ),
    (
        "joint_range",
        "joint 2",
        {"q_rad": [0.5, -1.0625], "q_set_rad": [0.5, -1.0]},
        {"q_rad": [0.5, -1.0625 - TINY], "q_set_rad": [0.5, -1.0], "speed_set_rad_s": [0.0, 1.0]},
    ),
    ("loop_late", "control loop", {"missed_in_row": 10}, {"missed_in_row": 11}),
]


@pytest.mark.parametrize(("code", "where", "at", "beyond"), AT_AND_BEYOND)
def test_a_limit_itself_is_in_order_and_what_is_beyond_is_a_fault(
    code: str, where: str, at: dict[str, Any], beyond: dict[str, Any]
) -> None:
    assert changed(**at).codes() == []
    assert changed(**beyond).codes() == [(code, where)]


@pytest.mark.parametrize("bit", range(8))
def test_each_fault_bit_of_a_drive_has_its_own_words(bit: int) -> None:
    faults = changed(drive_faults=[0, 1 << bit], statusword=[0x37, 0x08]).faults()
    assert [(fault.code, fault.where) for fault in faults] == [("drive_fault", "joint 2")]
    assert DRIVE_FAULTS[bit][0] in faults[0].message
    assert faults[0].reaction is Reaction.HOLD


@pytest.mark.parametrize("statusword", [0x00, 0x40, 0x21, 0x23, 0x07, 0x0F, 0x08])
def test_a_drive_that_left_operation_enabled_by_itself_is_found(statusword: int) -> None:
    assert changed(statusword=[statusword, 0x37]).codes() == [("drive_left", "joint 1")]
    assert changed(statusword=[statusword, 0x37], expected=Expectation(False, True, True)).codes() == []


@pytest.mark.parametrize("free_bits", [0x00, 0x10, 0x80, 0x90])
def test_bits_that_belong_to_no_state_do_not_matter(free_bits: int) -> None:
    assert changed(statusword=[OPERATION_ENABLED | free_bits] * 2).codes() == []


@pytest.mark.parametrize(
    ("flags", "homed", "unhomed"),
    [
        (ZERO_SET | SIGNAL_LOST, ["encoder_signal"], ["encoder_signal"]),
        (ZERO_SET | QUADRATURE_ERROR, ["encoder_miscount"], []),
        (0, ["zero_lost"], []),
        (SIGNAL_LOST | QUADRATURE_ERROR, ["encoder_signal", "zero_lost"], ["encoder_signal"]),
    ],
)
def test_what_a_channel_says_counts_as_far_as_its_angle_is_believed(flags: int, homed: list[str], unhomed: list[str]) -> None:
    cycle = changed(channel_flags=[ZERO_SET, flags])
    assert cycle.codes() == [(code, "joint 2") for code in homed]
    cycle.expected = Expectation(True, False, True)
    assert cycle.codes() == [(code, "joint 2") for code in unhomed]


def test_before_homing_an_angle_out_of_range_means_nothing() -> None:
    cycle = changed(q_rad=[0.5, 9.0], q_set_rad=[0.5, 9.0], expected=Expectation(True, False, True))
    assert cycle.codes() == []


def test_a_joint_that_was_taken_out_of_its_range_by_hand_may_be_held_there_but_goes_no_further() -> None:
    assert changed(q_rad=[0.5, 2.5], q_set_rad=[0.5, 2.5]).codes() == []
    assert ("joint_range", "joint 2") in changed(q_rad=[0.5, 2.5 + 0.0625 + TINY], q_set_rad=[0.5, 2.5]).codes()


def test_a_joint_that_lags_may_arrive_after_its_set_point_and_must_then_be_there() -> None:
    def found(after_s: float, error_rad: float) -> list[tuple[str, str]]:
        watch = Watch(LIMITS, ("joint 1", "joint 2"))
        assert changed(speed_set_rad_s=[0.0, 1.0]).codes(watch) == []  # 0.125 rad of lag
        now_s = NOW_S + after_s
        fresh = {"now_s": now_s, "encoder_at_s": now_s, "reply_at_s": [now_s] * 2}
        return changed(q_rad=[0.5, 0.5 + error_rad], **fresh).codes(watch)

    fault = [("following_error", "joint 2")]
    assert (found(0.0, 0.1875), found(0.0, 0.1875 + TINY)) == ([], fault)
    assert (found(0.125, 0.125), found(0.125, 0.125 + TINY)) == ([], fault)
    assert (found(12.375, 0.0625), found(12.375, 0.0625 + 0.002)) == ([], fault)


def test_motion_is_not_judged_where_nothing_is_controlled() -> None:
    cycle = changed(speed_rad_s=[9.0, 9.0], q_set_rad=[3.0, 3.0], expected=Expectation(True, True, False))
    assert cycle.codes() == []


def test_the_pauses_of_the_host_do_not_make_a_board_silent_but_its_own_silence_counts() -> None:
    watch = Watch(LIMITS, ("joint 1", "joint 2"))
    silent = changed(encoder_at_s=NOW_S - 0.125, reply_at_s=[NOW_S - 0.125] * 2)
    assert len(silent.codes(watch)) == 3
    watch.note_pause(NOW_S, 0.125 - 0.03125)
    assert silent.codes(watch) == []
    silent.encoder_at_s -= TINY
    assert silent.codes(watch) == [("encoder_stale", "encoder board")]


@pytest.mark.parametrize(("at_s", "for_how_long"), [(NOW_S - 0.0625, "for 0.062 s"), (-math.inf, "yet")])
def test_counts_that_are_missing_are_named_by_their_joint(at_s: float, for_how_long: str) -> None:
    (fault,) = changed(encoder_at_s=at_s, reported_at_s=[NOW_S, at_s]).faults()
    assert fault.message == f"no new counts of joint 2 {for_how_long} (limit 0.031 s)"


def test_a_loop_that_asked_one_board_for_long_has_not_heard_the_others() -> None:
    watch = Watch(LIMITS, ("joint 1", "joint 2"))
    waited_s = 0.5  # longer than a board may be silent
    watch.note_wait(NOW_S, waited_s)
    assert changed(reply_at_s=[NOW_S - waited_s] * 2).codes(watch) == []
    lately = changed(now_s=NOW_S + 0.125, encoder_at_s=NOW_S + 0.125, reply_at_s=[NOW_S - waited_s, NOW_S + 0.125])
    assert lately.codes(watch) == [("drive_silent", "joint 1")]


def test_a_pause_before_the_last_report_excuses_nothing() -> None:
    watch = Watch(LIMITS, ("joint 1", "joint 2"))
    watch.note_pause(NOW_S - 0.0625, 0.1)
    assert changed(encoder_at_s=NOW_S - 0.0625).codes(watch) == [("encoder_stale", "encoder board")]


def test_a_wait_for_one_board_is_not_the_silence_of_the_others() -> None:
    watch = Watch(LIMITS, ("joint 1", "joint 2"))
    watch.note_wait(NOW_S, 8.0)
    asleep = changed(encoder_at_s=NOW_S - 8.0 - 0.03125, reply_at_s=[NOW_S - 8.0 - 0.03125] * 2)
    assert asleep.codes(watch) == []
    asleep.encoder_at_s -= TINY
    assert asleep.codes(watch) == [("encoder_stale", "encoder board")]
    watch.note_wait(NOW_S - 0.0625, 8.0)
    for at_s in (NOW_S - 0.0625, NOW_S - 0.0625 + TINY):  # it came when that was over
        assert changed(encoder_at_s=at_s).codes(watch) == [("encoder_stale", "encoder board")]


def test_a_host_that_misses_every_second_deadline_finds_a_silent_board_in_twice_the_time() -> None:
    watch = Watch(LIMITS, ("joint 1", "joint 2"))
    found_s = math.inf
    for cycle in range(1, 40):
        now_s = NOW_S + 0.00390625 * cycle
        watch.note_pause(now_s, 0.001953125)
        if changed(now_s=now_s, encoder_at_s=NOW_S, reply_at_s=[now_s] * 2).codes(watch):
            found_s = min(found_s, now_s - NOW_S)
    assert found_s == pytest.approx(2 * LIMITS.stale_s, abs=0.004)


def test_a_host_that_is_mostly_away_does_not_hide_a_dead_board_beyond_the_watchdog() -> None:
    watch = Watch(LIMITS, ("joint 1", "joint 2"))
    for cycle in range(1, 100):
        now_s = NOW_S + 0.0078125 * cycle
        watch.note_pause(now_s, 0.0078125)
        found = changed(now_s=now_s, encoder_at_s=NOW_S, reply_at_s=[now_s] * 2).codes(watch)
        assert found == ([("encoder_stale", "encoder board")] if now_s - NOW_S > 0.25 else [])


@pytest.mark.parametrize("name", ["encoder_at_s", "reply_at_s", "q_rad", "speed_rad_s", "q_set_rad", "speed_set_rad_s"])
def test_a_number_that_is_none_is_never_in_order(name: str) -> None:
    value = math.nan if name == "encoder_at_s" else second(getattr(Cycle(), name)[0], math.nan)
    with contextlib.suppress(NotFinite):  # the loop brakes for that too
        assert changed(**{name: value}).faults()


def near(*values: float) -> st.SearchStrategy[float]:
    """Numbers at, just below and just above limits."""
    return st.sampled_from([v + d for v in values for d in (-TINY, 0.0, TINY)])


pairs = st.lists
CYCLES = st.builds(
    Cycle,
    encoder_at_s=near(NOW_S, NOW_S - 0.03125, NOW_S - 0.25),
    reply_at_s=pairs(near(NOW_S, NOW_S - 0.03125, NOW_S - 0.25), min_size=2, max_size=2),
    channel_flags=pairs(st.integers(0, 63), min_size=2, max_size=2),
    statusword=pairs(st.sampled_from([0x37, 0x27, 0xB7, 0x08, 0x40, 0x33]), min_size=2, max_size=2),
    drive_faults=pairs(st.sampled_from([0, 0, 1, 128, 5]), min_size=2, max_size=2),
    q_rad=pairs(near(0.5, 0.5625, 2.0625, -1.0625, 2.5), min_size=2, max_size=2),
    speed_rad_s=pairs(near(0.0, 4.0, -4.0), min_size=2, max_size=2),
    q_set_rad=pairs(near(0.5, 0.5625, 2.0, 2.5, -1.0), min_size=2, max_size=2),
    speed_set_rad_s=pairs(near(0.0, 1.0, -4.0), min_size=2, max_size=2),
    missed_in_row=st.sampled_from([0, 10, 11]),
    expected=st.builds(Expectation, st.booleans(), st.booleans(), st.booleans()),
)


class Thorough(Watch):
    """A watch that never trusts its quick look."""

    def _are_boards_well(self, now_s: float, feedback: Feedback, expected: Expectation) -> bool:
        return False


@settings(max_examples=600, deadline=None)
@given(CYCLES)
def test_the_quick_look_and_the_thorough_one_agree(cycle: Cycle) -> None:
    names = ("joint 1", "joint 2")
    assert cycle.codes(Watch(LIMITS, names)) == cycle.codes(Thorough(LIMITS, names))
