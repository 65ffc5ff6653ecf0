"""What drifts is found in histories of arms that are made and measured without this project's kinematics."""

import datetime
import json
import math
from functools import cache

import msgspec
import numpy as np

from benchmarks.calibration.ageing import ARM, BEGUN, TOLERANCE_m, entry_of, history
from benchmarks.calibration.chains import REFERENCE_DH
from calib.arm_problem.assembly import Choice
from calib.history import FORMAT, Entry, Quantity
from calib.results import json_text
from calib.trend import Trend, sentences, trend_json, trend_of

DAYS = (0.0, 40.0, 90.0, 150.0)
RATE = 6e-3  # rad in a year, of joint 2


@cache
def drifting() -> tuple[Entry, ...]:
    return history(DAYS, np.array([0.0, RATE, 0.0]), 3)


def measured_as(*dhs: np.ndarray) -> tuple[Entry, ...]:
    rng = np.random.default_rng(7)
    return tuple(entry_of(30.0 * k, dh, rng) for k, dh in enumerate(dhs))


def said(trend: Trend) -> str:
    return " ".join(sentences(trend))


def gaps(*values: float, sd: float | None = 1e-4, days: float = 30.0) -> tuple[Entry, ...]:
    of_play = [{"backlash1.width_rad": Quantity(value, sd)} for value in values]
    dates = [BEGUN + datetime.timedelta(days=days * k) for k in range(len(values))]
    return tuple(Entry(FORMAT, date, "gap", ARM.name, "test", {}, None, one) for date, one in zip(dates, of_play, strict=True))


def test_the_joint_that_drifts_is_named_with_its_rate_and_no_other() -> None:
    trend = trend_of(ARM, drifting())
    one, two, three = trend.rates
    assert (one.drifts, two.drifts, three.drifts) == (False, True, False)
    assert abs(two.change - RATE) < two.half < 0.2 * RATE
    assert abs(two.value) < 0.02  # from the pi / 2 of arm.toml
    assert trend.geometry is not None
    assert (trend.geometry.rest_drifts, trend.geometry.is_steady, trend.geometry.line.unseen) == (False, True, 0)
    assert "joint 2: zero drifts by " in said(trend)


def test_the_next_calibration_is_due_before_the_tip_has_drifted_that_far() -> None:
    found = trend_of(ARM, drifting(), TOLERANCE_m).due
    assert found is not None
    true_days = 365.25 * TOLERANCE_m / (RATE * 0.53)  # joint 2 moves the tip by some 0.53 m/rad over this workspace
    assert 0.4 * true_days < found.days < found.middle_days < 1.2 * true_days
    later = trend_of(ARM, drifting(), 4.0 * TOLERANCE_m).due
    assert later is not None
    assert later.days > found.days


def test_a_tolerance_below_what_a_calibration_knows_is_never_promised() -> None:
    trend = trend_of(ARM, drifting(), 1e-5)
    assert trend.due is not None
    assert trend.due.days == 0.0
    assert "cannot be promised" in said(trend)


def test_where_the_tool_was_identified_too_other_zeros_are_told_and_no_date() -> None:
    entries = history(DAYS, np.array([0.0, RATE, 0.0]), 3, Choice(freed=("tool",)))
    trend = trend_of(ARM, entries, TOLERANCE_m)
    assert [rate.name for rate in trend.rates] == ["joint 1: zero", "joint 2: zero"]  # the tool does what joint 3 does
    one, two = trend.rates
    assert (one.drifts, two.drifts) == (False, True)
    assert abs(two.change - RATE) < two.half < 0.3 * RATE
    assert trend.due is None
    assert "No date is promised" in said(trend)
    assert "More poses" not in said(trend)
    assert trend_of(ARM, (*entries[:2], *drifting()[2:]), TOLERANCE_m).due is None


def test_only_a_record_with_a_free_tool_says_so() -> None:
    free = history(DAYS[:1], np.zeros(3), 3, Choice(freed=("tool",)))
    written = [msgspec.json.decode(msgspec.json.encode(entry))["geometry"] for entry in (*free, drifting()[0])]
    assert [geometry.get("is_tool_free") for geometry in written] == [True, None]


def test_two_calibrations_tell_no_due_date_and_one_tells_nothing() -> None:
    two = trend_of(ARM, drifting()[:2], TOLERANCE_m)
    assert two.due is None
    assert "cannot be estimated for 0.5 mm yet: that needs at least 3 calibrations" in said(two)
    assert "A line through two points always fits" in said(two)
    trend = trend_of(ARM, drifting()[:1], TOLERANCE_m)
    assert (trend.geometry, trend.rates) == (None, ())
    assert "1 calibration and 0 gaps" in said(trend)
    assert "Drift shows between two calibrations of different days" in said(trend)
    assert "No drift" not in said(trend)


def test_a_jump_is_no_steady_drift() -> None:
    slipped = REFERENCE_DH.copy()
    slipped[1, 1] += 0.01
    trend = trend_of(ARM, measured_as(REFERENCE_DH, REFERENCE_DH, slipped, slipped, REFERENCE_DH))
    assert trend.geometry is not None
    assert not trend.geometry.is_steady
    assert not any(one.drifts for one in trend.rates)
    assert "the change is not steady" in said(trend)
    assert trend.geometry.odd is None


def test_the_one_calibration_that_contradicts_the_others_is_named() -> None:
    spoilt = REFERENCE_DH.copy()
    spoilt[1, 1] += 0.01
    trend = trend_of(ARM, measured_as(REFERENCE_DH, REFERENCE_DH, spoilt, REFERENCE_DH, REFERENCE_DH), 1e-4)
    assert trend.geometry is not None
    assert trend.geometry.odd is trend.entries[2]
    assert f"The calibration of {trend.entries[2].measured.date()} contradicts the others" in said(trend)
    assert "Find its cause first" in said(trend)


def test_a_link_that_grows_is_no_zero() -> None:
    tables = [REFERENCE_DH.copy() for _ in range(3)]
    for k, table in enumerate(tables):
        table[1, 3] += 0.004 * k  # the axis of joint 3 bends away
    trend = trend_of(ARM, measured_as(*tables))
    assert trend.geometry is not None
    assert trend.geometry.rest_drifts
    assert "Geometry changes beyond the joints' zeros" in said(trend)


def test_play_that_grows_is_named_by_gaps() -> None:
    (rate,) = trend_of(ARM, gaps(1e-3, 1.5e-3, 2.1e-3, 2.5e-3)).rates
    assert rate.drifts
    assert rate.name == "backlash on joint 1: width_rad"
    assert abs(rate.change - 0.51e-3 * 365.25 / 30.0) < rate.half
    (still,) = trend_of(ARM, gaps(1e-3, 1.1e-3, 0.9e-3, 1.0e-3)).rates
    assert not still.drifts


def test_values_without_standard_deviation_are_judged_by_their_scatter() -> None:
    (two,) = trend_of(ARM, gaps(1e-3, 2e-3, sd=None)).rates
    assert math.isinf(two.half)
    assert not two.drifts
    (four,) = trend_of(ARM, gaps(1e-3, 2.01e-3, 3e-3, 4e-3, sd=None)).rates
    assert four.drifts


def test_the_json_has_no_number_that_is_none() -> None:
    trend = trend_of(ARM, (*drifting(), *gaps(1e-3, 2e-3, sd=None)), TOLERANCE_m)
    content = json.loads(json_text(trend_json(trend)))
    assert content["format"] == "trend/1"
    rates = content["rates"]
    assert isinstance(rates, list)
    assert [one["half_interval"] is None for one in rates] == ["backlash" in one["name"] for one in rates]


def test_values_of_one_day_are_no_trend() -> None:
    assert trend_of(ARM, gaps(1e-3, 2e-3, 3e-3, days=0.0)).rates == ()


def test_a_jump_that_stays_is_a_step_between_two_dates() -> None:
    slipped = REFERENCE_DH.copy()
    slipped[1, 1] += 0.03
    entries = measured_as(REFERENCE_DH, REFERENCE_DH, slipped, slipped, slipped)
    trend = trend_of(ARM, entries, TOLERANCE_m)
    assert trend.step is not None
    assert (trend.step.before, trend.step.after, trend.step.alone) == (entries[1], entries[2], None)
    one, two, three = trend.step.changes
    assert (one.drifts, two.drifts, three.drifts, trend.step.has_rest) == (False, True, False, False)
    assert abs(two.change - 0.03) < two.half < 1e-3
    assert not any(rate.drifts for rate in trend.rates)  # of the three since then
    assert "changed at once: joint 2: zero by 30" in said(trend)
    assert "not steady" not in said(trend)
    assert trend.due is not None
    last = trend_of(ARM, entries[:3])  # a slip, or a spoilt calibration
    assert last.step is not None
    assert (last.step.alone, last.geometry) == (entries[2], None)
    assert "No drift" not in said(last)


def test_dates_in_the_future_are_remarked_on() -> None:
    now = drifting()[-1].measured - datetime.timedelta(days=10)
    assert "Dated in the future: 2026-05-31" in said(trend_of(ARM, drifting(), now=now))
    assert "future" not in said(trend_of(ARM, drifting(), now=drifting()[-1].measured))


def test_a_due_date_that_has_passed_is_called_so() -> None:
    last = drifting()[-1].measured
    soon, late = (said(trend_of(ARM, drifting(), TOLERANCE_m, last + datetime.timedelta(days=days))) for days in (1, 400))
    assert "That date has passed." not in soon
    assert "That date has passed." in late
