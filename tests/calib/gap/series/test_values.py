"""What is written of a law: values with intervals that hold, and what no file says is left open."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.gap.dynamic.cases import Asked, made
from benchmarks.gap.dynamic.score import arm_of
from benchmarks.gap.dynamic.score import log_of as log_of_case
from calib.arrays import Array
from calib.gap.effects.catalogue import known_laws, parameters, series_of, series_terms
from calib.gap.effects.gear import SPRING
from calib.gap.finding import EffectName
from calib.gap.posterior.evidence import Weighed
from calib.gap.residuals.rows import ResidualRows
from calib.gap.residuals.scene import Curve, OperatingPoint, SeriesScene, SeriesTerm
from calib.gap.residuals.whitening import Noise
from calib.gap.series.answer import covariance_of_values
from calib.gap.series.file import identified, jackknife_variance, with_least_left
from calib.gap.series.find import examine, find
from calib.gap.series.linear import SeriesLinear, Weighing, refitted, weighed, without_each
from calib.gap.series.split import split
from calib.gap.series.validation import Member
from calib.gap.signals.physics import Physics
from calib.gap.signals.recording import prepare
from calib.gap.signals.terms import Law
from tests.calib.gap.series.prescribed import LONG, log_of

pytestmark = pytest.mark.usefixtures("without_motion")

SPRING_2 = EffectName("joint_compliance", 2)
UNIT_rad_Nm, MOST_rad_Nm = 1e-3, 4e-3


def soft(size: float, sd: float) -> Member:
    """A softness in thousandths that its linearisation follows up to 4."""

    def law(c: np.ndarray) -> Law:
        return Law(SPRING_2, SPRING, (float(np.clip(c[0] * UNIT_rad_Nm, 0.0, MOST_rad_Nm)), 0.0, 0.0))

    term = SeriesTerm(SPRING_2, law=law, curve=Curve(1, 2e-3, 2.4e-3, UNIT_rad_Nm))
    return Member(0, term, np.array([size, 0.0]), np.diag([sd**2, 0.0]), np.zeros((2, 2)))


def test_a_value_within_its_range_is_known_as_well_as_its_coefficient() -> None:
    found = covariance_of_values(soft(3.0, 0.2))
    assert np.sqrt(found[0, 0]) == pytest.approx(0.2 * UNIT_rad_Nm)


def test_a_value_at_the_end_of_its_range_is_known_no_better_for_that() -> None:
    """The coefficient says 9, the law stays at 4: between them nothing tells."""
    found = covariance_of_values(soft(9.0, 0.2))
    assert np.sqrt(found[0, 0]) == pytest.approx(np.hypot(0.2, 5.0) * UNIT_rad_Nm)


@pytest.mark.parametrize(("of_posterior", "is_dropped"), [(1.2, False), (4.0, False), (0.3, False), (-0.3, True)])
def test_a_name_whose_interval_holds_nought_is_none(of_posterior: float, is_dropped: bool) -> None:
    """All values are sure by themselves. The file has 1; its interval goes from there to the posterior's value."""
    belt = EffectName("belt_coupling", 3)
    draw = np.random.default_rng(5)
    columns = draw.standard_normal((400, 1))
    term = SeriesTerm(belt, law=lambda c: Law(belt, SPRING, (float(c[0]), 0.0, 0.0)), response={0: columns})
    cell, groups = SimpleNamespace(rows=slice(None)), [np.arange(400) % 4 == k for k in range(4)]
    scene = SimpleNamespace(cells=[cell], usable=np.ones(400, dtype=bool), told=None)
    linear = SimpleNamespace(y=columns[:, 0] + 0.5 * draw.standard_normal(400), terms=())
    fit: Any = SimpleNamespace(linear=linear, point=SimpleNamespace(scene=scene, known=()))
    parts: Any = SimpleNamespace(groups=groups, deciding=np.ones(400, dtype=bool))
    member = Member(0, term, np.array([of_posterior]), np.diag([0.1**2]), np.zeros((1, 1)))
    assert (belt in identified(fit, [member], parts).dropped) == is_dropped


def test_a_law_that_jumps_is_written_where_it_leaves_least() -> None:
    """What is left falls from the posterior's 1.9 towards nought, and jumps to nothing at 2: a command a whole sample late."""
    late, along = EffectName("command_delay"), np.linspace(-1.0, 1.0, 50)
    series, spread = series_of(late.effect), np.array([0.1])
    assert series is not None

    def left_by(laws: Mapping[EffectName, Law]) -> Array:
        (delay,) = laws[late].values
        return along * (5.0 + delay if delay < 2.0 else 100.0 * (delay - 2.0) ** 2)

    (found,) = with_least_left(left_by, {late: Law(late, series.form, (1.9,))}, {late: spread})[late].values
    assert found == pytest.approx(2.0, abs=0.02)


@pytest.fixture(scope="module")
def around() -> OperatingPoint:
    """A model that has a spring on joint 2."""
    known = known_laws(LONG)
    rows = ResidualRows(Physics(LONG, prepare(LONG, log_of(LONG))), known)
    law = Law(SPRING_2, SPRING, (1e-3, 2.3, 0.1))
    return OperatingPoint.of(SeriesScene(rows, known), known, {SPRING_2: law})


def test_each_linearisation_counts_a_damping_from_what_dampings_are_like(around: OperatingPoint) -> None:
    """Counted from what was found, each would allow it to go as far again."""
    spring = next(series_terms(around, keys={SPRING_2}))
    assert spring.law is not None
    assert spring.now is not None
    assert len(spring.now) == spring.count
    assert spring.now[-2:] == pytest.approx([(2.3 - 0.8) / 0.5, 0.1 / 0.5])
    assert spring.law(spring.now).values == pytest.approx((1e-3, 2.3, 0.1))
    assert spring.law(np.eye(spring.count)[0]).values[1:] == pytest.approx((0.8, 0.0))


def test_a_spring_is_written_with_its_damping_however_little_is_known_of_it() -> None:
    """A file without one says that it swings on and on, which no gear does."""
    law = Law(SPRING_2, SPRING, (1e-3, 0.6, 0.0))
    said = parameters(LONG, law, np.diag([1e-10, 0.5**2, 0.0]))
    assert said["damping_Nm_s_rad"] == pytest.approx((0.6, 0.5))


def test_a_group_of_runs_is_left_out_as_if_it_had_not_been_recorded(around: OperatingPoint) -> None:
    scene = around.scene
    linear = SeriesLinear.around(around, list(series_terms(around, keys={SPRING_2})))
    parts = split(scene.recording, scene.rows.table)
    noises = [Noise.white(len(scene.recording.runs))] * len(scene.cells)
    fit = weighed(around, linear, noises, parts, [])
    fit = replace(fit, decision=replace(fit.decision, best=Weighed(((0, 5),), 1.0, 0.0)))
    first = parts.groups[0]
    rest = replace(fit, weighing=Weighing(linear, noises, scene.picked(parts.deciding & ~first)))
    whole, without = without_each(fit, [np.zeros_like(first), first])
    assert whole == pytest.approx(refitted(fit, [0])[0])
    assert without == pytest.approx(refitted(rest, [0])[0])
    assert without != pytest.approx(whole, rel=1e-3)


def test_one_weighing_alone_has_its_gram_matrix_and_another_makes_the_same_anew(around: OperatingPoint) -> None:
    scene, linear = around.scene, SeriesLinear.around(around, list(series_terms(around, keys={SPRING_2})))
    rows, noises = scene.picked(scene.usable), [Noise.white(len(scene.recording.runs))] * len(scene.cells)
    one, other = Weighing(linear, noises, rows), Weighing(linear, noises, rows & (np.arange(len(rows)) % 2 == 0))
    first, usable = one.gram, scene.usable
    assert one.gram is first
    assert other.gram.apart.freedom < first.apart.freedom
    scene.keep(np.arange(len(usable)) % 3 > 0)  # whatever rows are usable meanwhile
    again = one.gram
    scene.keep(usable)
    assert again is not first
    assert np.array_equal(again.apart.tip, first.apart.tip)


def test_the_variance_of_a_mean_follows_from_the_means_of_all_groups_but_one() -> None:
    values = np.random.default_rng(5).normal(size=(9, 2))
    parted = np.array([np.delete(values, k, axis=0).mean(axis=0) for k in range(9)])
    assert jackknife_variance(parted) == pytest.approx(values.var(axis=0, ddof=1) / 9)
    assert not jackknife_variance(parted[:2]).any()


def test_a_rotor_that_the_file_does_not_know_is_said_and_taken_for_no_other_effect() -> None:
    drives = tuple(replace(one, rotor_inertia_kg_m2=0.0) for one in LONG.drives)
    laws = ("link_inertia", "joint_compliance", "torque_constant")
    found = examine(replace(LONG, drives=drives), log_of(LONG), candidates=laws)
    assert found.finding.effects == ()
    said = [text for text in found.warnings if "knows no rotor_inertia_kg_m2" in text]
    assert len(said) == len(LONG.drives)
    for text, drive in zip(said, LONG.drives, strict=True):
        value = float(text.split(" some ")[1].split(" kg m2")[0])
        assert value == pytest.approx(drive.rotor_inertia_kg_m2, rel=0.2)


@pytest.mark.nightly
def test_a_gear_that_is_soft_and_loose_is_named_as_both() -> None:
    (case,) = made([Asked(500_001, "joint_compliance+backlash", 2)])
    found = find(arm_of(case.arm_toml), log_of_case(case))
    assert {one.name for one in found.effects} == {SPRING_2, EffectName("backlash", 2)}
    for one, hidden in zip(sorted(found.effects, key=lambda one: -len(one.name.effect)), case.truth, strict=True):
        for key, true in hidden["parameters"].items():
            value, sd = one.parameters[key]
            assert abs(value - true) < 1.96 * sd < 0.3 * true
    assert found.gap_after < 1.1
