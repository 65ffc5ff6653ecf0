"""Limits at their boundaries: the bound passes, the next float does not, and every clip says why."""

import math
import random

import pytest

from control.errors import ArmError
from control.safety import limits
from control.safety.limits import Allowed, Clip, NotFinite, OUTSIDE_rad, SetPointLimits, UniqueTurn

T = 0.002
JOINT = SetPointLimits(lower_rad=-1.0, upper_rad=1.0, speed_rad_s=2.0, acceleration_rad_s2=10.0)
CHANGE = 10.0 * T


def _above(value):
    return math.nextafter(value, math.inf)


def _below(value):
    return math.nextafter(value, -math.inf)


def _step(wanted, last=0.0, speed=0.0, limit=JOINT):
    result = limits.limit_set_point((wanted,), (last,), (speed,), (limit,), T)
    return result.q_rad[0], result.speed_rad_s[0], [clip.limit for clip in result.reasons]


@pytest.mark.parametrize("bound", [-2.0, 3.0, _above(-2.0), _below(3.0), 0.0])
def test_clamp_lets_the_bounds_and_what_lies_between_pass_unchanged(bound):
    assert limits.clamp(bound, -2.0, 3.0, "voltage") == Allowed(bound, ())


@pytest.mark.parametrize(("wanted", "bound"), [(_above(3.0), 3.0), (1e300, 3.0), (_below(-2.0), -2.0), (-1e300, -2.0)])
def test_clamp_stops_at_the_bound_and_says_why(wanted, bound):
    allowed = limits.clamp(wanted, -2.0, 3.0, "voltage", 2)
    assert allowed == Allowed(bound, (Clip("voltage", 2, wanted, bound),))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_clamp_refuses_what_is_not_finite(bad):
    with pytest.raises(NotFinite, match="voltage"):
        limits.clamp(bad, -1.0, 1.0, "voltage")


@pytest.mark.parametrize(("lower", "upper"), [(1.0, _below(1.0)), (math.nan, 1.0), (0.0, math.nan)])
def test_clamp_refuses_crossed_or_missing_bounds(lower, upper):
    with pytest.raises(NotFinite):
        limits.clamp(0.5, lower, upper, "voltage")
    assert limits.clamp(5.0, 1.0, 1.0, "voltage").value == 1.0


def test_a_clip_reads_as_a_sentence_with_joint_and_both_values():
    assert str(Clip("speed limit [rad/s]", 2, 2.5, 2.0)) == "joint 2 speed limit [rad/s]: wanted 2.5, allowed 2"
    assert str(Clip("supply", 0, 2.5, 2.0)) == "supply: wanted 2.5, allowed 2"


@pytest.mark.parametrize("speed", [0.0, 2.0, -2.0])
def test_a_set_point_inside_all_limits_passes_bit_for_bit(speed):
    wanted = 0.3 + speed * T
    assert _step(wanted, 0.3, speed) == (wanted, (wanted - 0.3) / T, [])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_acceleration_limit_is_met_exactly_and_clips_beyond(sign):
    assert _step(sign * CHANGE * T)[2] == []
    q, speed, reasons = _step(sign * 1.01 * CHANGE * T)
    assert reasons == [limits.ACCELERATION]
    assert q == pytest.approx(sign * CHANGE * T, abs=1e-11)
    assert speed == pytest.approx(sign * CHANGE, abs=1e-8)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_braking_harder_than_the_acceleration_limit_clips(sign):
    assert _step(sign * (1.0 - CHANGE) * T, 0.0, sign)[2] == []
    q, _, reasons = _step(0.0, 0.0, sign)
    assert reasons == [limits.ACCELERATION]
    assert q == pytest.approx(sign * (1.0 - CHANGE) * T, abs=1e-11)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_speed_limit_is_met_exactly_and_clips_beyond(sign):
    assert _step(sign * 2.0 * T, 0.0, sign * 2.0)[2] == []
    q, speed, reasons = _step(sign * 2.005 * T, 0.0, sign * 2.0)
    assert reasons == [limits.SPEED]
    assert q == pytest.approx(sign * 2.0 * T, abs=1e-11)
    assert speed == pytest.approx(sign * 2.0, abs=1e-8)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_step_to_the_end_of_the_range_passes_and_past_it_stops_there(sign):
    end, near = sign * 1.0, sign * (1.0 - 0.5 * CHANGE * T)
    assert _step(end, near)[0] == end
    assert _step(end, near)[2] == []
    q, _, reasons = _step(sign * (1.0 + 0.2 * CHANGE * T), near)
    assert q == end
    assert reasons == [limits.RANGE]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rounding_past_the_end_of_the_range_is_taken_back_without_a_reason(sign):
    near = sign * (1.0 - 0.5 * CHANGE * T)
    assert _step(sign * (1.0 + 1e-13), near)[::2] == (sign * 1.0, [])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_range_wins_over_the_acceleration_limit(sign):
    q, speed, reasons = _step(sign * 1.5, sign * 0.9999, sign * 2.0)
    assert sign * q <= 1.0
    assert abs(speed) < 2.0 - CHANGE
    assert reasons == [limits.ACCELERATION, limits.SPEED, limits.RANGE]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_outside_its_range_a_joint_may_stay_or_return_but_goes_no_further_out(sign):
    out = sign * 1.2
    assert _step(out, out)[::2] == (out, [])
    back = sign * (1.2 - 0.5 * CHANGE * T)
    assert _step(back, out)[0] == back
    assert _step(back, out)[2] == []
    q, _, reasons = _step(sign * (1.2 + 0.5 * CHANGE * T), out)
    assert q == out
    assert reasons == [limits.RANGE]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("which", ["wanted", "last", "speed"])
def test_a_set_point_that_is_not_finite_is_refused_and_names_its_joint(bad, which):
    numbers = {"wanted": (0.0, 0.0), "last": (0.0, 0.0), "speed": (0.0, 0.0)} | {which: (0.0, bad)}
    with pytest.raises(NotFinite, match="joint 2 set-point"):
        limits.limit_set_point(numbers["wanted"], numbers["last"], numbers["speed"], (JOINT, JOINT), T)


def test_every_joint_is_limited_by_its_own_limits_and_clips_name_it():
    slow = SetPointLimits(-1.0, 1.0, 0.1, 1e6)
    result = limits.limit_set_point((0.001, 0.001, 0.0), (0.0,) * 3, (0.5, 0.1, 0.0), (JOINT, slow, slow), T)
    assert result.q_rad[0] == 0.001
    assert result.q_rad[1] == pytest.approx(0.1 * T, abs=1e-11)
    assert [(clip.joint, clip.limit) for clip in result.reasons] == [(2, limits.SPEED)]


def test_a_wrong_number_of_joints_is_refused():
    with pytest.raises(ValueError, match=r"shorter|longer"):
        limits.limit_set_point((0.0,), (0.0, 0.0), (0.0,), (JOINT,), T)


@pytest.mark.parametrize("speed", [0.15, 0.9, 2.0, -0.15, -0.9, -2.0])
@pytest.mark.parametrize("middle", [0.0, 0.7, -3.0, 3.0])
def test_running_at_constant_speed_into_either_end_of_any_range_is_braked_in_time(speed, middle):
    limit = SetPointLimits(middle - 1.0, middle + 1.0, 2.0, 10.0)
    q, last_speed, wanted = middle, speed, middle
    for _ in range(5000):
        wanted = min(max(wanted + speed * T, middle - 1.0), middle + 1.0)
        new, new_speed, _ = _step(wanted, q, last_speed, limit)
        assert abs(new_speed - last_speed) <= CHANGE * (1.0 + 1e-6)
        q, last_speed = new, new_speed
    assert q == pytest.approx(middle + math.copysign(1.0, speed), abs=1e-9)


@pytest.mark.parametrize("goal", [5.0, -5.0])
def test_pushed_at_the_end_of_its_range_a_joint_stops_there_within_its_acceleration(goal):
    q, speed, fastest = 0.0, 0.0, 0.0
    for _ in range(2000):
        new, new_speed, _ = _step(goal, q, speed)
        assert abs(new_speed - speed) <= CHANGE * (1.0 + 1e-6)
        assert abs(new) <= 1.0
        q, speed, fastest = new, new_speed, max(fastest, abs(new_speed))
    assert q == pytest.approx(math.copysign(1.0, goal), abs=1e-9)
    assert fastest == pytest.approx(2.0, abs=1e-6)


def test_any_sequence_of_wanted_set_points_keeps_every_limit():
    numbers = random.Random(11)
    q = speed = 0.0
    for _ in range(20_000):
        wanted = numbers.choice([q, 2.0, -2.0, q + numbers.gauss(0.0, 0.01), numbers.uniform(-1.0, 1.0)])
        new, new_speed, reasons = _step(wanted, q, speed)
        assert -1.0 <= new <= 1.0
        assert abs(new_speed) <= 2.0 + 1e-8
        assert abs(new_speed - speed) <= CHANGE + 1e-7
        assert bool(reasons) or new == wanted
        q, speed = new, new_speed


@pytest.mark.parametrize("cycles", [1, 2, 3, 7, 50])
@pytest.mark.parametrize("part", [0.0, 0.25, 0.999])
def test_stopping_speed_is_exactly_what_cycle_wise_braking_uses_up(cycles, part):
    speed = (cycles + part) * CHANGE
    distance, remaining = 0.0, speed
    while remaining > 0.0:
        distance += remaining * T
        remaining -= CHANGE
    assert limits.stopping_speed(distance, 10.0, T) == pytest.approx(speed, rel=1e-9)


@pytest.mark.parametrize("distance", [0.0, -0.0, -1e-300, -1.0])
def test_stopping_speed_is_zero_where_no_distance_is_left(distance):
    assert limits.stopping_speed(distance, 10.0, T) == 0.0
    assert limits.stopping_speed(1e-12, 10.0, T) > 0.0


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("field", ["speed_rad_s", "acceleration_rad_s2"])
def test_limits_that_are_not_positive_and_finite_are_refused(field, bad):
    values = {"lower_rad": -1.0, "upper_rad": 1.0, "speed_rad_s": 1.0, "acceleration_rad_s2": 1.0} | {field: bad}
    with pytest.raises(ArmError, match=field):
        SetPointLimits(**values)


@pytest.mark.parametrize(
    ("lower", "upper"), [(1.0, 1.0), (1.0, 0.0), (math.nan, 1.0), (0.0, math.nan), (-math.inf, 0.0), (0.0, math.inf)]
)
def test_a_joint_range_must_be_in_order_and_finite(lower, upper):
    with pytest.raises(ArmError, match="joint range"):
        SetPointLimits(lower, upper, 1.0, 1.0)


def test_voltage_range_keeps_the_current_limit_around_the_back_emf():
    assert limits.voltage_range(24.0, 8.0, 0.25, 5.0) == (3.0, 7.0)
    assert limits.voltage_range(24.0, 8.0, 0.25, -5.0) == (-7.0, -3.0)


@pytest.mark.parametrize(
    ("back_emf", "expected"),
    [(22.0, (20.0, 24.0)), (22.5, (20.5, 24.0)), (-22.5, (-24.0, -20.5)), (30.0, (24.0, 24.0)), (-30.0, (-24.0, -24.0))],
)
def test_voltage_range_ends_at_the_voltage_limit_and_is_never_crossed(back_emf, expected):
    assert limits.voltage_range(24.0, 8.0, 0.25, back_emf) == expected


@pytest.mark.parametrize("position", range(4))
def test_voltage_range_refuses_nan(position):
    numbers = [24.0, 8.0, 0.25, 5.0]
    numbers[position] = math.nan
    with pytest.raises(NotFinite):
        limits.voltage_range(*numbers)


@pytest.mark.parametrize("speed", [0.5, -0.5])
def test_allowed_lag_grows_with_speed_in_both_directions_at_once(speed):
    assert limits.allowed_lag(0.0, 0.1, 0.0, 0.002) == 0.0
    assert limits.allowed_lag(speed, 0.1, 0.0, 0.002) == 0.05
    assert limits.allowed_lag(speed, 0.1, 0.049, 0.0) == 0.05


@pytest.mark.parametrize("lag_s", [0.02, 0.05, 0.5])
@pytest.mark.parametrize("deceleration", [5.0, 20.0, 1e3])
def test_allowed_lag_holds_the_error_of_every_first_order_lag_up_to_its_time(lag_s, deceleration):
    """A move of 1 rad/s that ends: each joint that follows with a time constant up to lag_s is within what is allowed."""
    period_s, speed, allowed, errors = 1e-3, 0.0, 0.0, {lag_s * share: 0.0 for share in (0.1, 0.5, 1.0)}
    for cycle in range(4000):
        speed = min(1.0, speed + 20.0 * period_s) if cycle < 2000 else max(0.0, speed - deceleration * period_s)
        allowed = limits.allowed_lag(speed, lag_s, allowed, period_s)
        for time_s, error in errors.items():
            errors[time_s] = (error + speed * period_s) * time_s / (time_s + period_s)
            assert errors[time_s] <= allowed + 1e-12
    assert allowed < 0.03 * lag_s  # and at rest nothing of it is left


def test_without_a_lag_time_nothing_is_allowed_for_it():
    assert limits.allowed_lag(3.0, 0.0, 1.0, 0.0) == 0.0


def test_allowed_lag_of_a_speed_that_is_none_is_forgotten_with_it():
    assert math.isnan(limits.allowed_lag(math.nan, 0.1, 0.5, 0.002))
    assert limits.allowed_lag(0.0, 0.1, math.nan, 0.002) == 0.0


@pytest.mark.parametrize("measured", [2.0, -2.0])
def test_overrun_is_zero_at_the_limit_and_positive_beyond_in_both_directions(measured):
    assert limits.overrun(measured, 2.0) == 0.0
    assert limits.overrun(measured * 1.25, 2.0) == 0.5
    assert limits.overrun(measured * 0.75, 2.0) == -0.5


@pytest.mark.parametrize(("measured", "limit"), [(math.nan, 1.0), (math.inf, 1.0), (0.0, math.nan)])
def test_overrun_refuses_what_is_not_finite(measured, limit):
    with pytest.raises(NotFinite, match="finite"):
        limits.overrun(measured, limit)


def test_age_at_its_limit_is_fresh_and_beyond_it_is_stale():
    assert not limits.is_stale(1.25, 1.0, 0.25)
    assert limits.is_stale(_above(1.25), 1.0, 0.25)
    assert limits.is_stale(1.0, None, 0.25)
    assert limits.is_stale(1.0, math.nan, 0.25)


def test_a_clip_of_no_joint_names_none():
    assert str(limits.clamp(2.0, 0.0, 1.0, "current [A]").reasons[0]) == "current [A]: wanted 2, allowed 1"


def test_a_joint_that_brakes_softly_is_slowed_long_before_the_end_of_its_range():
    soft = SetPointLimits(-1.0, 1.0, speed_rad_s=10.0, acceleration_rad_s2=0.25)
    (clip,) = limits.limit_set_point([0.9006], [0.9], [0.3], [soft], 0.002).reasons
    assert clip.limit == limits.RANGE  # 0.3 rad/s need 0.18 rad, 0.1 rad are left


@pytest.mark.parametrize(("turn_rad", "allowed_rad"), [(6.0, OUTSIDE_rad), (4.25, 0.125)])
def test_a_joint_may_stand_a_little_outside_but_not_nearer_to_its_other_end_a_turn_on(turn_rad, allowed_rad):
    turn = UniqueTurn(0, "joint 1", lower_rad=-2.0, upper_rad=2.0, turn_rad=turn_rad)
    for side in (1.0, -1.0):
        assert turn.objection(side * 2.0) == ""
        assert turn.objection(side * (2.0 + 0.99 * allowed_rad)) == ""
        said = turn.objection(side * (2.0 + 1.01 * allowed_rad))
        assert f"{1.01 * allowed_rad:.3f} rad outside its limits" in said
        assert "its encoder may be a turn off" in said
