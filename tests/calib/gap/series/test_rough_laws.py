"""Laws that are only roughly right, on prescribed motions, are named as what they are."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks.gap.dynamic.cases import made
from benchmarks.gap.dynamic.score import arm_of
from benchmarks.gap.dynamic.score import log_of as log_of_case
from benchmarks.gap.dynamic.series_score import asked
from calib.arrays import Array
from calib.gap.finding import EffectName, GapFinding, as_totals, updated_arm
from calib.gap.series.find import examine, find
from tests.calib.gap.series.prescribed import LONG, VISCOUS, COULOMB_Nm, Hidden, arm_with_friction, log_of

pytestmark = pytest.mark.usefixtures("without_motion")

ARM = arm_with_friction()


def hiding(law: Hidden | None = None) -> GapFinding:
    return find(ARM, log_of(ARM) if law is None else log_of(ARM, law))


def names(found: GapFinding) -> set[EffectName]:
    return {effect.name for effect in found.effects}


def test_two_laws_that_are_only_roughly_right_are_both_named_as_what_they_are() -> None:
    """Friction by load that follows the angle by 6 %, and viscous friction that bends by as much."""

    def law(j: int, q: Array, speed: Array, link: Array) -> Array:
        if j == 1:
            return np.asarray(0.2 * np.abs(link) * np.sign(speed) * (1.0 + 0.06 * np.sin(2.0 * q + 1.0)))
        return np.asarray(0.6 * speed * (1.0 + 0.06 * np.abs(speed))) if j == 2 else np.zeros_like(q)

    found = hiding(law)
    assert names(found) == {EffectName("load_friction", 2), EffectName("viscous_friction", 3)}
    for effect in found.effects:
        assert effect.probability > 0.95
        assert effect.departure < 0.24
    load = next(one for one in found.effects if one.name.effect == "load_friction")
    value, sd = load.parameters["fraction"]
    assert value == pytest.approx(0.2, rel=0.1)
    assert abs(value - 0.2) < 3.0 * sd
    assert found.gap_explained < 1.3 < found.gap_after < 0.06 * found.gap_before  # no file says how a part departs


def test_a_value_is_within_its_interval_where_laws_that_the_file_has_depart_by_a_few_per_cent() -> None:
    """Their own values take most of what they do, the named law a part: its error is no noise, and is counted."""

    def law(j: int, q: Array, speed: Array, link: Array) -> Array:
        level = 0.08 * COULOMB_Nm[0] * np.sin(2.0 * q + 2.0) * np.sign(speed)
        bent = 0.08 * VISCOUS[0] * np.abs(speed) * speed
        return (0.25 * np.abs(link) * np.sign(speed) + level + bent) * (j == 0)

    laws = ("load_friction", "coulomb_friction", "viscous_friction", "cogging")
    (found,) = examine(LONG, log_of(LONG, law), candidates=laws).finding.effects
    assert found.name == EffectName("load_friction", 1)
    value, sd = found.parameters["fraction"]
    assert abs(value - 0.25) < min(0.02, 1.96 * sd)


def test_what_the_file_has_besides_a_name_is_identified_with_it_and_alone_stays_as_it_was_given() -> None:
    """Viscous friction of 4 % more is too little for a name, and three times the noise."""

    def more(j: int, q: Array, speed: Array, link: Array) -> Array:
        return 0.04 * VISCOUS[1] * speed * (j == 1)

    def both(j: int, q: Array, speed: Array, link: Array) -> Array:
        return np.asarray(more(j, q, speed, link) + 0.2 * np.abs(link) * np.sign(speed) * (j == 1))

    laws = ("load_friction", "coulomb_friction", "viscous_friction")
    alone = examine(ARM, log_of(ARM, more), candidates=laws).finding
    assert (alone.effects, alone.refitted) == ((), ())
    assert alone.gap_after == alone.gap_before
    found = examine(ARM, log_of(ARM, both), candidates=laws).finding
    assert names(found) == {EffectName("load_friction", 2)}
    values = {effect.name: effect.parameters for effect in as_totals(ARM, found).refitted}
    viscous = EffectName("viscous_friction", 2)
    assert values[viscous]["coefficient_Nm_s_rad"][0] == pytest.approx(1.04 * VISCOUS[1], rel=0.01)
    file = {(one.effect, one.joint): one.parameters for one in updated_arm(ARM, as_totals(ARM, found)).effects}
    assert file["viscous_friction", 2] == {key: value for key, (value, _) in values[viscous].items()}
    assert found.gap_after < 1.1


@pytest.mark.nightly
def test_what_is_no_law_of_the_sensors_is_not_taken_off_and_the_file_leaves_the_currents_as_they_were() -> None:
    (case,) = made([asked("rough", 482_003)])  # a drift that the camera alone sees; samples are read at once
    found = find(arm_of(case.arm_toml), log_of_case(case))
    assert names(found) == {EffectName("thermal_drift", 1)}
    assert found.after_si["tip_m"] < 1.1 * found.noise_floor["tip_m"]
    for channel in ("current_A", "voltage_V"):
        assert found.after_si[channel] == pytest.approx(found.before_si[channel], rel=1e-6)


@pytest.mark.nightly
def test_a_drift_that_had_gone_by_before_the_runs_is_a_zero_and_no_drift() -> None:
    """The same log, whose clock began earlier: a drift of seconds is then an angle that is always off."""
    (case,) = made([asked("rough", 1_821_007)])
    log = log_of_case(case)
    later = dataclasses.replace(log, runs=tuple(dataclasses.replace(run, t_s=run.t_s + 100.0) for run in log.runs))
    in_time, gone_by = (find(arm_of(case.arm_toml), one, candidates=("thermal_drift", "encoder_scale")) for one in (log, later))
    assert names(in_time) == {EffectName("thermal_drift", 2)}
    assert names(gone_by) == set()
    assert gone_by.unknown is not None
