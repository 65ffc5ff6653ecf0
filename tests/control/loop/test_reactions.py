"""What each finding leads to, written out again: its code, its joint, how the arm comes to rest; and limits, joint by joint."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from control.dynamics.feedforward import Motor
from control.hardware.interface import Feedback
from control.loop.cross_checks import CrossCheckLimits, CrossChecks, IndexWatch, MotorCountWatch, SwitchPlace, SwitchWatch
from control.loop.watch import Expectation, MeasuredLimits, Watch, WatchLimits
from control.motion.setpoint import SetPoint
from control.safety.modes import LOSES_ZERO, Fault, Reaction

CYCLE_s = 0.002
NAMES = ("joint 1", "joint 2")
MOTOR = Motor(amperes_per_Nm=0.5, resistance_ohm=2.0, volts_per_rad_s=4.0, supply_V=24.0, current_limit_A=8.0)
LIMITS = CrossCheckLimits(0.5, 0.25, 0.75, 1.25, 80.0)
# Numbers of docs/encoder_board.md and docs/motor_board.md, not of the code.
HOME, ZERO_SET, QUADRATURE_ERROR, SIGNAL_LOST = 0x04, 0x08, 0x10, 0x20
OPERATION_ENABLED, LIMITING = 0x27, 0x80
DRIVE_FAULTS = {
    0x01: "over-current",
    0x02: "over-temperature",
    0x04: "supply too low",
    0x08: "supply too high",
    0x10: "watchdog",
    0x20: "encoder",
    0x40: "bad command",
    0x80: "emergency stop",
}
REACTIONS = {
    "encoder_stale": Reaction.HOLD,
    "drive_silent": Reaction.HOLD,
    "drive_fault": Reaction.HOLD,
    "drive_left": Reaction.HOLD,
    "zero_lost": Reaction.HOLD,
    "encoder_signal": Reaction.BRAKE,
    "encoder_miscount": Reaction.BRAKE,
    "encoder_leap": Reaction.BRAKE,
    "overspeed": Reaction.BRAKE,
    "following_error": Reaction.CONTROLLED,
    "joint_range": Reaction.CONTROLLED,
    "loop_late": Reaction.CONTROLLED,
    "encoder_contradicted": Reaction.BRAKE,
    "unexplained_torque": Reaction.CONTROLLED,
    "supply": Reaction.BRAKE,
    "over_current": Reaction.BRAKE,
    "over_temperature": Reaction.CONTROLLED,
    "encoders_differ": Reaction.BRAKE,
    "switch_off": Reaction.CONTROLLED,
    "index_off": Reaction.CONTROLLED,
}


def good(now_s: float = 8.0) -> Feedback:
    """A cycle of two joints in which all is well."""
    feedback = Feedback(2)
    feedback.encoder_at_s = now_s
    feedback.reply_at_s, feedback.reported_at_s = [now_s] * 2, [now_s] * 2
    feedback.channel_flags, feedback.statusword = [ZERO_SET] * 2, [OPERATION_ENABLED] * 2
    feedback.supply_V, feedback.temperature_C = [24.0] * 2, [30.0] * 2
    feedback.sent_V = [0.0] * 2
    return feedback


def both_at(q_rad: float, speed_rad_s: float = 0.0) -> SetPoint:
    return SetPoint((q_rad,) * 2, (speed_rad_s,) * 2, (0.0,) * 2)


def limits_of_watch() -> WatchLimits:
    limit = MeasuredLimits(-1.0, 2.0, 0.0625, 4.0, 0.0625, 0.125)
    return WatchLimits((limit, limit), stale_s=0.03125, silent_s=0.25, missed_in_row=10)


def looked(
    change: Callable[[Feedback], object] = lambda _: None,
    q_rad: float = 0.5,
    speed_rad_s: float = 0.0,
    q_set_rad: float = 0.5,
    missed: int = 0,
) -> list[Fault]:
    feedback = good()
    change(feedback)
    return Watch(limits_of_watch(), NAMES).look(
        8.0, feedback, both_at(q_rad, speed_rad_s), both_at(q_set_rad), missed, Expectation(True, True, True)
    )


def both(name: str, value: object) -> Callable[[Feedback], None]:
    return lambda feedback: setattr(feedback, name, [value, value])


def said(faults: list[Fault]) -> list[tuple[str, str]]:
    assert [fault.reaction for fault in faults] == [REACTIONS[fault.code] for fault in faults]
    return [(fault.code, fault.where) for fault in faults]


@pytest.mark.parametrize(
    ("code", "change"),
    [
        ("drive_silent", both("reply_at_s", 7.9)),
        ("drive_left", both("statusword", 0x23)),
        ("zero_lost", both("channel_flags", 0x00)),
        ("encoder_signal", both("channel_flags", ZERO_SET | SIGNAL_LOST)),
        ("encoder_miscount", both("channel_flags", ZERO_SET | QUADRATURE_ERROR)),
        *(("drive_fault", both("drive_faults", bit)) for bit in DRIVE_FAULTS),
    ],
)
def test_what_happens_to_all_joints_at_once_is_found_on_all(code: str, change: Callable[[Feedback], None]) -> None:
    assert said(looked(change)) == [(code, name) for name in NAMES]


def test_motions_of_all_joints_that_are_wrong_at_once_are_found_on_all() -> None:
    assert said(looked(speed_rad_s=4.5)) == [("overspeed", name) for name in NAMES]
    assert said(looked(q_rad=0.6)) == [("following_error", name) for name in NAMES]
    assert said(looked(q_rad=2.1, q_set_rad=2.0625)) == []  # held where a hand has left it
    assert said(looked(q_rad=2.0625, q_set_rad=2.0)) == []
    assert said(looked(q_rad=2.07, q_set_rad=2.0)) == [
        (code, name) for name in NAMES for code in ("following_error", "joint_range")
    ]


def test_a_joint_at_its_limit_is_in_order_beside_one_beyond_it() -> None:
    def look(q_rad: tuple[float, ...], speed_rad_s: tuple[float, ...]) -> list[tuple[str, str]]:
        expected = Expectation(True, True, True)
        watch = Watch(limits_of_watch(), NAMES)
        return said(watch.look(8.0, good(), SetPoint(q_rad, speed_rad_s, ()), both_at(0.5), 0, expected))

    assert look((0.5, 0.5), (4.0, 4.5)) == [("overspeed", "joint 2")]
    assert look((0.5625, 0.625), (0.0, 0.0)) == [("following_error", "joint 2")]


class Quick(Watch):
    """A watch whose thorough look must not be needed."""

    def _boards(self, now_s: float, feedback: Feedback, expected: Expectation) -> list[Fault]:
        raise AssertionError("looked thoroughly")


def test_a_cycle_in_order_needs_no_thorough_look() -> None:
    watch, expected = Quick(limits_of_watch(), NAMES), Expectation(True, True, True)
    still = both_at(0.5), both_at(0.5)
    assert watch.look(8.0, good(), *still, 10, expected) == []
    watch.note_pause(8.0, 0.125)
    assert watch.look(8.0, good(7.875), *still, 0, expected) == []  # the host's own pause
    for speed_set_rad_s in (2.0, -2.0):  # a joint that moves may follow further behind
        assert watch.look(8.0, good(), both_at(0.5), both_at(0.6, speed_set_rad_s), 0, expected) == []
    wild = both_at(9.0, 9.0), both_at(0.5)
    assert watch.look(8.0, good(), *wild, 0, Expectation(True, True, False)) == []
    unhomed = good()
    unhomed.channel_flags = [ZERO_SET | 0x01, QUADRATURE_ERROR]
    assert watch.look(8.0, unhomed, *still, 0, Expectation(True, False, True)) == []
    with pytest.raises(AssertionError, match="thoroughly"):
        watch.look(8.0, good(), *still, 11, expected)


def test_a_silent_encoder_board_and_a_late_loop_are_one_finding_each() -> None:
    assert said(looked(lambda feedback: setattr(feedback, "encoder_at_s", 7.9))) == [("encoder_stale", "encoder board")]
    assert said(looked(missed=11)) == [("loop_late", "control loop")]


def test_messages_say_how_long_a_board_has_been_silent_and_how_far_a_joint_is_off() -> None:
    silent, off = looked(both("reply_at_s", 7.9))[0], looked(q_rad=0.6)[0]
    assert "no reply for 0.100 s (limit 0.031 s)" in silent.message
    (unheard,) = looked(lambda feedback: setattr(feedback, "encoder_at_s", 7.9))
    assert "0.100 s (limit 0.031 s)" in unheard.message
    assert "following error -0.1000 rad (limit 0.0625 rad at 0.00 rad/s)" in off.message


def test_a_leap_is_a_fault_of_the_joint_that_made_it() -> None:
    watch = Watch(limits_of_watch(), NAMES)
    assert said(watch.miscounts([0.0, 0.0], [False, False], True)) == []
    assert said(watch.miscounts([0.0, -0.2], [False, False], False)) == [("encoder_leap", "joint 2")]
    assert said(watch.miscounts([0.1, 0.2], [False, False], True)) == [("encoder_leap", name) for name in NAMES]
    assert said(watch.miscounts([0.0, 0.0], [False, True], True)) == [("zero_lost", "joint 2")]
    assert said(watch.miscounts([0.0, 0.0], [False, True], False)) == []


@pytest.mark.parametrize("bit", DRIVE_FAULTS)
def test_a_fault_bit_says_what_the_document_says(bit: int) -> None:
    faults = looked(both("drive_faults", bit))
    assert all(DRIVE_FAULTS[bit] in fault.message for fault in faults)
    two = looked(both("drive_faults", bit | 0x10))
    assert len(two) == (2 if bit == 0x10 else 4)


def test_reactions_have_an_order_of_severity() -> None:
    assert Reaction.CONTROLLED < Reaction.HOLD < Reaction.BRAKE


def test_faults_that_are_not_the_zeros_leave_it() -> None:
    assert {
        "zero_lost",
        "encoder_signal",
        "encoder_miscount",
        "encoder_leap",
        "encoder_contradicted",
        "encoders_differ",
        "index_off",
        "switch_off",
        "overspeed",
    } == LOSES_ZERO
    assert set(REACTIONS) >= LOSES_ZERO


class Checked:
    """Two joints' checks, cycle by cycle."""

    def __init__(self) -> None:
        self.cross_checks, self.feedback = CrossChecks([MOTOR, MOTOR], LIMITS, NAMES), good(0.0)
        self.now_s = 0.0
        self.speed_rad_s = [0.0, 0.0]
        self.model_A: list[float] | None = [0.0, 0.0]

    def after(self, cycles: int) -> list[tuple[str, str]]:
        """The findings of the last of so many cycles; none may come before."""
        found: list[Fault] = []
        for _ in range(cycles):
            assert not found, f"found early: {found}"
            self.now_s += CYCLE_s
            self.feedback.reply_at_s, self.feedback.reported_at_s = [self.now_s] * 2, [self.now_s] * 2
            found = self.cross_checks.look(self.now_s, CYCLE_s, self.feedback, self.speed_rad_s, self.model_A)
        self.last = found
        return said(found)

    def until_found(self, most: int = 500) -> tuple[int, list[tuple[str, str]]]:
        for cycle in range(1, most):
            if found := self.after(1):
                return cycle, found
        return most, []


@pytest.mark.parametrize(
    ("code", "name", "inside", "outside"),
    [
        ("supply", "supply_V", 18.0, 17.99),
        ("supply", "supply_V", 30.0, 30.01),
        ("over_current", "current_A", 12.0, 12.01),
        ("over_current", "current_A", -12.0, -12.01),
        ("over_temperature", "temperature_C", 80.0, 80.1),
        ("supply", "supply_V", 24.0, math.nan),
        ("over_temperature", "temperature_C", -40.0, math.nan),
        ("over_current", "current_A", 0.0, math.nan),
    ],
)
def test_a_value_outside_of_its_limits_for_ten_cycles_is_found_on_its_joint(
    code: str, name: str, inside: float, outside: float
) -> None:
    arm = Checked()
    arm.model_A = None
    arm.feedback.sent_V = [math.nan] * 2
    values = getattr(arm.feedback, name)
    values[1] = inside
    assert arm.after(30) == []
    values[1] = outside
    assert arm.after(9) == []
    values[1] = inside
    assert arm.after(1) == []
    values[1] = outside
    assert arm.after(10) == [(code, "joint 2")]


def test_a_motor_that_turns_while_its_encoder_stands_is_found_on_its_joint() -> None:
    arm = Checked()
    arm.feedback.sent_V[1] = 4.0  # 1 rad/s by voltage; 0.5 is allowed
    cycle, found = arm.until_found()
    assert found == [("encoder_contradicted", "joint 2")]
    assert 8 <= cycle <= 25
    arm.cross_checks.forget()
    arm.speed_rad_s[1] = 1.0
    assert arm.after(200) == []


def test_a_board_that_limits_its_output_says_nothing_of_its_voltage() -> None:
    arm = Checked()
    arm.feedback.sent_V[1] = 4.0
    arm.feedback.statusword[1] |= LIMITING
    assert arm.after(200) == []


@pytest.mark.parametrize(("age_of_reply", "age_of_count", "is_used"), [(1.4, 2.9, True), (1.6, 0.0, False), (0.0, 3.1, False)])
def test_values_of_different_moments_are_not_compared(age_of_reply: float, age_of_count: float, is_used: bool) -> None:
    cross_checks, feedback = CrossChecks([MOTOR], LIMITS, NAMES[:1]), good(0.0)
    feedback.sent_V = [4.0, 0.0]
    found: list[Fault] = []
    for k in range(300):
        now_s = k * CYCLE_s
        feedback.reply_at_s, feedback.reported_at_s = ([now_s - age_of_reply * CYCLE_s], [now_s - age_of_count * CYCLE_s])
        found += cross_checks.look(now_s, CYCLE_s, feedback, [0.0], [0.0])
    assert bool(found) == is_used


def test_a_supply_that_is_off_excuses_a_speed_that_is_off_by_as_much() -> None:
    arm = Checked()
    arm.feedback.sent_V, arm.speed_rad_s = [20.0, 20.0], [5.0, 5.0]
    assert arm.after(200) == []
    arm.feedback.supply_V = [28.8, 28.8]  # a duty cycle of it turns the motor a fifth faster
    arm.speed_rad_s = [6.0, 6.0]
    assert arm.after(200) == []


def test_a_supply_that_is_low_excuses_as_much_as_one_that_is_high() -> None:
    arm = Checked()
    arm.feedback.sent_V, arm.feedback.supply_V = [20.0, 20.0], [19.2, 19.2]  # a fifth below 24 V
    arm.speed_rad_s = [4.0, 4.0]
    assert arm.after(200) == []
    arm.speed_rad_s = [2.5, 2.5]  # 10 V are missing, of which 4 V are the supply's and 2.5 V the share of the terms
    assert arm.until_found()[1] == [("encoder_contradicted", name) for name in NAMES]


def test_after_old_values_both_equations_wait_for_new_ones() -> None:
    arm = Checked()
    arm.feedback.sent_V[0], arm.feedback.current_A[1], arm.feedback.sent_V[1] = 4.0, 9.0, math.nan
    arm.model_A = None
    before, found = arm.until_found()
    assert found == [("encoder_contradicted", "joint 1")]
    arm.model_A = [0.0, 0.0]
    old = arm.now_s - 0.1
    arm.feedback.reply_at_s = [old, old]
    look = arm.cross_checks.look
    assert not [look(arm.now_s, CYCLE_s, arm.feedback, [0.0, 0.0], arm.model_A) for _ in range(300)][-1]
    arm.model_A = None
    assert arm.until_found() == (before, found)


def test_a_torque_that_the_model_does_not_explain_is_found_on_its_joint() -> None:
    arm = Checked()
    arm.feedback.sent_V = [math.nan] * 2
    arm.feedback.current_A[1] = 2.0  # a quarter of 8 A is allowed
    assert arm.after(600) == []
    arm.feedback.current_A[1] = 2.2
    assert arm.until_found()[1] == [("unexplained_torque", "joint 2")]
    text = arm.last[0].message
    assert "gives 4." in text  # 2 A at 2 N m an ampere
    assert "limit 4.0 N m" in text
    arm.model_A = [0.0, 0.5]
    arm.cross_checks.forget()
    assert arm.after(600) == []
    arm.model_A = [0.0, 0.0]
    again = arm.until_found()
    arm.model_A = None
    arm.feedback.current_A[1] = 9.0
    assert arm.after(600) == []
    arm.feedback.current_A[1], arm.model_A = 2.2, [0.0, 0.0]
    fresh = Checked()
    fresh.feedback.sent_V, fresh.feedback.current_A[1] = [math.nan] * 2, 2.2
    assert arm.until_found() == fresh.until_found()
    assert again[1] == [("unexplained_torque", "joint 2")]


def test_checks_that_start_anew_forget_what_they_saw() -> None:
    arm = Checked()
    arm.feedback.sent_V = [4.0, math.nan]
    before, found = arm.until_found()
    assert found == [("encoder_contradicted", "joint 1")]
    for forget in (arm.cross_checks.forget, arm.cross_checks.forget_speeds):
        assert arm.until_found() == (1, found)
        forget()
        assert arm.until_found() == (before, found)


def test_what_is_forgotten_of_speeds_is_not_forgotten_of_torques() -> None:
    arm = Checked()
    arm.feedback.sent_V, arm.feedback.current_A[1] = [math.nan] * 2, 2.2
    before, found = arm.until_found()
    arm.cross_checks.forget_speeds()
    assert arm.until_found() == (1, found)
    arm.cross_checks.forget()
    assert arm.until_found() == (before, found)


def test_a_contradiction_says_both_speeds_and_a_torque_its_size() -> None:
    arm = Checked()
    arm.feedback.sent_V[1] = 8.0
    found: list[Fault] = []
    while not found:
        arm.now_s += CYCLE_s
        arm.feedback.reply_at_s, arm.feedback.reported_at_s = [arm.now_s] * 2, [arm.now_s] * 2
        found = arm.cross_checks.look(arm.now_s, CYCLE_s, arm.feedback, [0.0, 0.0], None)
    assert "its encoder says 0.000 rad/s" in found[0].message
    assert "say 0." in found[0].message


def test_two_counts_of_one_motor_that_differ_are_found_on_its_joint_whatever_wraps() -> None:
    def faults(*counts: tuple[int, int], speed_rad_s: float = 0.0, bits: int = 32) -> list[tuple[str, str]]:
        watch = MotorCountWatch((100.0, -100.0), (bits, bits), NAMES)
        found: list[Fault] = []
        for count, motor_count in counts:
            found += watch.look([(1, count, motor_count)], [0.0, speed_rad_s])
        return said(found)

    one = [("encoders_differ", "joint 2")]
    assert faults((5, 900), (5, 900)) == []
    assert faults((0, 0), (16, 0)) == []
    assert faults((0, 0), (17, 0)) == one
    assert faults((0, 0), (-17, 0)) == one
    assert faults((0, 0), (100, 80)) == []  # 16 and a quarter of 80
    assert faults((0, 0), (117, 80)) == one
    assert faults((0, 0), (-100, -80)) == []
    assert faults((0, 0), (30, 0), speed_rad_s=-20.0) == []
    assert faults((0, 2**31 - 10), (200, -(2**31) + 10)) == one
    assert faults((0, 0), (100, -100)) == one
    assert faults((0, 0), (30, 0), speed_rad_s=20.0) == []  # 7 ms at 2000 counts/s: 14 more
    assert faults((0, 0), (31, 0), speed_rad_s=-20.0) == one
    assert faults((2**31 - 10, 0), (-(2**31) + 10, 20)) == []
    assert faults((0, 2**31 - 10), (20, -(2**31) + 10)) == []
    assert faults((32760, 0), (-32760, 16), bits=16) == []
    assert faults((32760, 0), (-32760, 16), bits=32) == one
    assert faults((0, 0), (32768, 0), bits=16) == one  # half of what it counts, and not nothing


def test_a_board_that_was_off_is_not_compared_with_before() -> None:
    watch = MotorCountWatch((100.0,), (32,), NAMES[:1])
    assert watch.look([(0, 0, 0)], [0.0]) == []
    watch.forget()
    assert watch.look([(0, 5000, 0)], [0.0]) == []
    assert said(watch.look([(0, 9000, 0)], [0.0])) == [("encoders_differ", "joint 1")]
    watch.forget()
    watch.look([(0, 0, 0)], [0.0])
    assert "has counted 500, its motor board 80" in watch.look([(0, 500, 80)], [0.0])[0].message
    fast = MotorCountWatch((100.0,), (32,), NAMES[:1])
    fast.look([(0, 0, 0)], [20.0])
    assert fast.look([(0, 30, 0)], [0.0]) == []  # the faster of the two moments counts


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_joint_on_the_wrong_side_of_its_switch_for_ten_cycles_is_found(sense: float) -> None:
    def cycles(q_rad: float, flags: int, count: int) -> list[tuple[str, str]]:
        watch = SwitchWatch([None, SwitchPlace("joint 2", 0.5, sense, 0.125)])
        found: list[Fault] = []
        for _ in range(count):
            found += watch.look(CYCLE_s, [9.0, q_rad], [0, flags])
        return said(found)

    beyond, short = 0.5 + sense * 0.25, 0.5 - sense * 0.25
    assert cycles(beyond, HOME | ZERO_SET, 40) == []
    assert cycles(short, ZERO_SET, 40) == []
    assert cycles(beyond, ZERO_SET, 9) == []
    assert cycles(beyond, ZERO_SET, 10) == [("switch_off", "joint 2")]
    assert cycles(short, HOME, 10) == [("switch_off", "joint 2")]
    for q_rad in (0.5 + 0.125, 0.5 - 0.125):
        assert cycles(q_rad, 0, 40) == cycles(q_rad, HOME, 40) == []


def test_a_switch_that_bounces_is_right_again_with_the_first_look_that_says_so() -> None:
    watch = SwitchWatch([SwitchPlace("joint 1", 0.5, 1.0, 0.125)])
    for looks in ([9, 1, 9, 1], [1, 40]):
        for number, count in enumerate(looks):
            for _ in range(count):
                assert watch.look(CYCLE_s, [0.75], [ZERO_SET if number % 2 == 0 else HOME | ZERO_SET]) == []


def test_an_index_pulse_elsewhere_is_found_and_the_first_one_is_the_reference() -> None:
    def watch(given: int | None) -> IndexWatch:
        return IndexWatch((1000, 1000), (None, given), lambda joint, count: count + 7000 * joint, NAMES)

    known = watch(7020)
    assert known.look([(1, 20), (1, 1020), (1, -1980), (1, 40), (1, 0)]) == []
    assert said(known.look([(1, 41)])) == [("index_off", "joint 2")]
    assert said(known.look([(1, -1)])) == [("index_off", "joint 2")]
    assert said(known.look([(1, 520), (1, 1041)])) == [("index_off", "joint 2")] * 2
    learnt = watch(None)
    assert learnt.look([(1, 300), (1, 1300)]) == []
    assert said(learnt.look([(1, 330)])) == [("index_off", "joint 2")]
    learnt.forget()
    assert learnt.look([(1, 330)]) == []
    coarse = IndexWatch((100,), (0,), lambda joint, count: count, NAMES[:1])
    assert coarse.look([(0, 4), (0, 96)]) == []
    assert said(coarse.look([(0, 5)])) == [("index_off", "joint 1")]
