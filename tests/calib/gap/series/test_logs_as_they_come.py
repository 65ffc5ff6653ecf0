"""Logs as other people's controllers write them: clocks, rates, units and gaps are recognised and said, never named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.arrays import Array
from calib.gap.effects.catalogue import known_laws
from calib.gap.log import UNITS, Log, LoggedRun, amperes_per, log_in_amperes, with_ideal_drives, without_voltages
from calib.gap.residuals.rows import ResidualRows, without_motion
from calib.gap.series.plausible import plausible
from calib.gap.signals.body import BodyTorques, Load
from calib.gap.signals.motion import motion_gaps
from calib.gap.signals.physics import Physics
from calib.gap.signals.recording import RunSet, UnusableLogError, part_of, prepare
from calib.gap.signals.sampling import period_of
from calib.gap.signals.terms import Law
from control.model.description import arm_text, load_arm, parse_arm
from tests.calib.gap.series.prescribed import arm_with_friction, log_of

ARM = arm_with_friction()
LOG = log_of(ARM)
RATE_Hz = 500.0
SAMPLED = ("q_rad", "q_set_rad", "current_A", "voltage_V", "payload_kg", "tip_m")


def changed(change: Callable[[LoggedRun], LoggedRun]) -> Log:
    return Log(tuple(change(run) for run in LOG.runs))


def at(run: LoggedRun, t_s: Array) -> LoggedRun:
    """A run brought to other times, on lines between its samples."""

    def brought(values: Array) -> Array:
        columns = values[:, None] if values.ndim == 1 else values
        found = np.stack([np.interp(t_s, run.t_s, column) for column in columns.T], axis=1)
        return np.asarray(found[:, 0] if values.ndim == 1 else found)

    tip = np.full((len(t_s), 3), np.nan)
    columns = {name: brought(getattr(run, name)) for name in SAMPLED if name != "tip_m"}
    return replace(run, t_s=t_s, tip_m=tip, **columns)


def rows(run: LoggedRun, keep: Array) -> LoggedRun:
    return replace(run, t_s=run.t_s[keep], **{name: getattr(run, name)[keep] for name in SAMPLED})


def said(recording: RunSet) -> str:
    return " ".join(recording.warnings)


def test_a_clock_that_counts_since_1970_gives_the_same_samples() -> None:
    recording = prepare(ARM, changed(lambda run: replace(run, t_s=1.7e9 + 100.0 * float(run.name) + run.t_s)))
    plain = prepare(ARM, LOG)
    assert recording.filters.rate_Hz == pytest.approx(RATE_Hz, rel=1e-6)
    for own, other in zip(recording.runs, plain.runs, strict=True):
        np.testing.assert_array_equal(own.q_raw, other.q_raw)
        np.testing.assert_allclose(own.t_s, other.t_s, atol=2e-6)
    assert not recording.warnings


def test_stamps_that_were_rounded_stand_for_even_samples() -> None:
    """333 samples a second, stamps in whole milliseconds: 3 ms, 3 ms, 3 ms, and now and then one more."""

    def rounded(run: LoggedRun) -> LoggedRun:
        return replace(run, t_s=np.round(1.5 * run.t_s * 1.00123, 3))

    recording = prepare(ARM, changed(rounded))
    assert recording.filters.rate_Hz == pytest.approx(RATE_Hz / 1.5 / 1.00123, rel=1e-4)
    for own, run in zip(recording.runs, LOG.runs, strict=True):
        np.testing.assert_array_equal(own.q_raw, run.q_rad)


def test_the_period_is_the_span_over_the_samples_whatever_was_lost_or_came_late() -> None:
    t = np.arange(2000) / RATE_Hz
    late = t + np.where(np.arange(2000) % 50 == 7, 0.0012, 0.0)
    lost = np.delete(t, np.arange(100, 1900, 30))
    alternating = np.cumsum(np.tile([0.010, 0.010, 0.012], 500))  # a real controller's: the median is 10 ms
    for stamps, period_s in ((t, 0.002), (late, 0.002), (lost, 0.002), (alternating, 0.032 / 3)):
        run = replace(LOG.runs[0], t_s=stamps)
        assert period_of([run]) == pytest.approx(period_s, rel=1e-3)


@pytest.mark.parametrize("factor", [2, 4])
def test_a_log_that_was_interpolated_is_taken_back_to_what_was_measured(factor: int) -> None:
    finer = changed(lambda run: at(run, np.arange((len(run) - 1) * factor + 1) / (factor * RATE_Hz)))
    recording = prepare(ARM, finer)
    assert recording.filters.rate_Hz == pytest.approx(RATE_Hz, rel=1e-4)
    assert f"{factor - 1} of {factor} samples lies on the line" in said(recording)
    np.testing.assert_allclose(recording.runs[0].q_raw, LOG.runs[0].q_rad, atol=1e-9)


def test_samples_that_are_written_twice_are_taken_once() -> None:
    def doubled(run: LoggedRun) -> LoggedRun:
        twice = rows(run, np.repeat(np.arange(len(run)), 2))
        return replace(twice, t_s=np.arange(len(twice)) / (2.0 * RATE_Hz))

    recording = prepare(ARM, changed(doubled))
    assert recording.filters.rate_Hz == pytest.approx(RATE_Hz, rel=1e-3)
    assert "repeats the one before" in said(recording)


def test_a_log_at_a_rate_of_its_own_keeps_its_currents_and_not_its_voltages() -> None:
    """From 500 to 1250 samples a second: which voltages were held in between is lost."""
    finer = changed(lambda run: at(run, np.arange(0.0, float(run.t_s[-1]), 1.0 / 1250.0)))
    recording = plausible(ARM, prepare(ARM, finer))
    assert recording.has_current
    assert not recording.has_voltage
    assert "brought to another rate" in said(recording)


def test_copies_of_runs_are_used_once_and_are_no_repeats() -> None:
    twice = Log((*LOG.runs, *(replace(run, name=f"again {run.name}") for run in LOG.runs)))
    recording = prepare(ARM, twice)
    assert recording.repeats == prepare(ARM, LOG).repeats
    assert "7 runs (again 1, again 2, again 3, again 4 and others): copies of others, used once" in said(recording)


def test_links_without_inertia_are_said() -> None:
    links = tuple(replace(one, inertia_kg_m2=(0.0, 0.0, 0.0)) if one.inertia_kg_m2 else one for one in ARM.links)
    recording = prepare(replace(ARM, links=links), LOG)
    assert "inertia_kg_m2 of link 1, 2, 3 is zero" in said(recording)


def test_torques_of_joints_without_drives_leave_voltages_aside() -> None:
    assert not prepare(with_ideal_drives(replace(ARM, drives=())), without_voltages(LOG)).has_voltage


def irregular(run: LoggedRun) -> LoggedRun:
    rng = np.random.default_rng(int(run.name))
    steps = 0.002 * (1.0 + 0.25 * rng.uniform(-1.0, 1.0, len(run)))
    t = np.cumsum(steps)
    return at(run, t[t < run.t_s[-1]])


def test_an_irregular_clock_is_said_once_and_its_repeats_are_known() -> None:
    log = changed(lambda run: replace(irregular(run), voltage_V=np.full((len(irregular(run)), 3), np.nan)))
    recording = prepare(ARM, log)
    assert recording.filters.rate_Hz == pytest.approx(RATE_Hz, rel=5e-3)
    assert said(recording).count("interpolated") == 1
    assert "7 runs (1, 2, 3, 4 and others)" in said(recording)
    assert recording.repeats == prepare(ARM, LOG).repeats


def test_gaps_of_all_runs_are_one_sentence() -> None:
    recording = prepare(ARM, changed(lambda run: rows(run, np.r_[0:300, 330:700, 720 : len(run)])))
    (sentence,) = (one for one in recording.warnings if "gaps" in one)
    assert "14 gaps, the longest 0.062 s" in sentence


def test_samples_that_come_as_events_are_no_time_series() -> None:
    rng = np.random.default_rng(5)

    def events(run: LoggedRun) -> LoggedRun:
        return rows(run, np.flatnonzero(np.repeat(rng.random(len(run) // 10) < 0.35, 10) & (rng.random(len(run)) < 0.5)))

    with pytest.raises(UnusableLogError, match="as events do"):
        prepare(ARM, changed(events))


@pytest.mark.parametrize("unit", [unit for unit in UNITS if unit not in ("A", "percent")])
def test_currents_in_another_unit_are_recognised_and_the_option_reads_them(unit: str) -> None:
    strange = changed(lambda run: replace(run, current_A=run.current_A / amperes_per(ARM, unit)))
    recording = plausible(ARM, prepare(ARM, strange))
    assert not recording.has_current
    assert f"--current-unit {unit};" in said(recording)
    given = log_in_amperes(ARM, strange, unit)
    np.testing.assert_allclose(given.runs[0].current_A, LOG.runs[0].current_A)


def test_torques_of_an_arm_whose_friction_nobody_knows_are_recognised() -> None:
    bare = replace(ARM, effects=())
    strange = changed(lambda run: replace(run, current_A=run.current_A / amperes_per(ARM, "Nm")))
    assert "--current-unit Nm;" in said(plausible(bare, prepare(bare, strange)))
    assert plausible(bare, prepare(bare, LOG)).has_current


def test_one_factor_on_all_joints_is_another_unit_and_no_torque_constant() -> None:
    recording = plausible(ARM, prepare(ARM, changed(lambda run: replace(run, current_A=0.3 * run.current_A))))
    assert not recording.has_current
    assert "the same on all joints" in said(recording)


def test_a_swing_with_the_driver_off_needs_no_currents_and_no_voltages() -> None:
    nothing = np.full((len(LOG.runs[0]), 3), np.nan)
    off = changed(lambda run: replace(run, current_A=nothing, voltage_V=nothing, is_commanded=True))
    recording = plausible(ARM, prepare(ARM, replace(off, runs=tuple(replace(r, tip_m=nothing) for r in off.runs))))
    assert recording.has_voltage
    assert all(run.is_off.all() for run in recording.runs)
    assert len(ResidualRows(Physics(ARM, recording), known_laws(ARM)).table.run)


def test_five_thousand_samples_a_second_are_averaged_where_no_voltage_was_held_between_them() -> None:
    def fast(run: LoggedRun) -> LoggedRun:
        rng = np.random.default_rng(int(run.name))
        t_s = np.arange(0.0, 1.9, 1.0 / 5000.0)
        finer = at(run, t_s)
        tip = np.full((len(t_s), 3), np.nan)
        tip[7::50] = 0.3
        noise = rng.normal(0.0, 0.05, (len(t_s), 3))
        nothing = np.full((len(t_s), 3), np.nan)
        return replace(finer, current_A=finer.current_A + noise, voltage_V=nothing, tip_m=tip, q_rad=finer.q_rad + 1e-6 * noise)

    recording = prepare(ARM, changed(fast))
    assert recording.filters.rate_Hz == pytest.approx(1000.0, rel=1e-3)
    assert "means of 5 are used" in said(recording)
    assert all(len(run.frames) > 25 for run in recording.runs)  # of 38 a run: none falls between two means
    assert "means of" not in said(prepare(ARM, changed(lambda run: replace(fast(run), is_commanded=True))))


def test_a_long_log_is_used_in_part_with_its_loads_and_repeats_and_that_is_said() -> None:
    log = Log(tuple(replace(run, name=f"{part}-{run.name}") for part in range(20) for run in LOG.runs))
    part, sentence = part_of(log)
    length_s = sum(float(run.t_s[-1]) for run in part.runs)
    assert 100.0 < length_s < 140.0
    assert f"280 s long: {length_s:.0f} s of it are used" in sentence
    assert {run.payload for run in part.runs} == {run.payload for run in log.runs}
    assert any(len(group) > 1 for group in part.repeats())
    assert part_of(LOG) == (LOG, "")


def test_a_long_run_is_used_in_blocks_over_its_whole_length() -> None:
    t_s = np.arange(0.0, 335.0, 0.002)
    q = np.stack([0.4 * np.sin(0.6 * t_s + joint) * (0.2 + t_s / 335.0) for joint in range(3)], axis=1)
    nothing = np.full((len(t_s), 3), np.nan)
    run = LoggedRun("1", t_s, q, q, q, nothing, np.zeros(len(t_s)), nothing)
    part, _ = part_of(Log((run,)))
    assert len(part.runs) > 6
    assert all(9.0 < one.t_s[-1] - one.t_s[0] < 11.0 for one in part.runs)
    assert part.runs[0].t_s[0] < 30.0
    assert part.runs[-1].t_s[-1] > 300.0
    assert sum(float(one.t_s[-1] - one.t_s[0]) for one in part.runs) < 140.0


def slow(run: LoggedRun) -> LoggedRun:
    """A two-thousandth of the angles, without camera and voltages: nothing is faster than 8 mrad/s."""
    first = run.q_rad[0]
    nothing = np.full_like(run.q_rad, np.nan)
    return replace(run, q_rad=first + 0.0005 * (run.q_rad - first), tip_m=nothing, voltage_V=nothing)


def test_a_log_of_motions_that_are_too_slow_is_refused_in_words() -> None:
    recording = prepare(ARM, changed(slow))
    with pytest.raises(UnusableLogError, match="faster than 8 mrad/s"):
        without_motion(ResidualRows(Physics(ARM, recording), known_laws(ARM)).table)


def test_a_link_without_inertia_divides_nothing_by_nought() -> None:
    links = tuple(
        link if link.inertia_kg_m2 is None else replace(link, inertia_kg_m2=(0.0, 0.0, 0.0), mass_kg=0.0)
        for link in load_arm("right").links
    )
    body = BodyTorques(replace(ARM, links=links), prepare(ARM, LOG))
    assert all((part > 0.0).all() for joint in range(3) for part in body.own_inertia(Load(), joint))


def test_a_model_that_runs_away_from_a_slow_log_gives_no_figure_and_no_failure() -> None:
    """Gains of a loop of 500 cycles a second, simulated at 50."""
    recording = prepare(ARM, changed(lambda run: rows(run, np.arange(0, len(run), 10))))
    physics = Physics(ARM, recording)
    pushing: tuple[Law, ...] = known_laws(ARM)
    found = motion_gaps(physics, pushing, pushing, [run.name for run in recording.runs])
    assert all(np.isfinite(one.after_rad) for one in found.values())


def test_an_arm_with_ideal_drives_can_be_written_and_read() -> None:
    """Of torques of joints whose drives nobody gave, or one only: each has a node of its own."""
    for drives in ((), ARM.drives[1:2]):
        arm = with_ideal_drives(replace(ARM, drives=drives))
        assert len(parse_arm(arm_text(arm), Path("arm.toml")).drives) == ARM.joint_count
