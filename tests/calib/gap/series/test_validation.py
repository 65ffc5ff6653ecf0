"""Names that the held-out runs contradict are taken back, and said."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calib.arrays import Array
from calib.gap.effects.catalogue import known_laws
from calib.gap.finding import EffectName
from calib.gap.log import Log, LoggedRun
from calib.gap.residuals.rows import ResidualRows
from calib.gap.series import answer, find
from calib.gap.series.find import DynamicOutcome, examine
from calib.gap.series.split import split
from calib.gap.signals.physics import Physics
from calib.gap.signals.recording import prepare
from tests.calib.gap.series.prescribed import arm_with_friction, log_of

pytestmark = pytest.mark.usefixtures("without_motion")

ARM = arm_with_friction()
LOAD_2 = EffectName("load_friction", 2)


def link_friction(joint: int, q: Array, speed: Array, link: Array) -> Array:
    return 0.2 * np.abs(link) * np.sign(speed) if joint == 1 else np.zeros_like(q)


@cache
def reporting() -> tuple[str, ...]:
    """The runs that only report, whatever is hidden."""
    recording = prepare(ARM, log_of(ARM))
    return split(recording, ResidualRows(Physics(ARM, recording), known_laws(ARM)).table).report_runs


def contradicted() -> DynamicOutcome:
    """Load friction in all runs; in those that only report, the other way round. With it in all, it is named (test_motion)."""
    plain, rubbed = log_of(ARM), log_of(ARM, link_friction)

    def mixed(run: LoggedRun, other: LoggedRun) -> LoggedRun:
        share = -1.0 if run.name in reporting() else 1.0
        current = run.current_A + share * (other.current_A - run.current_A)
        voltage = run.voltage_V + share * (other.voltage_V - run.voltage_V)
        return replace(run, current_A=current, voltage_V=voltage)

    runs = tuple(mixed(run, other) for run, other in zip(plain.runs, rubbed.runs, strict=True))
    return examine(ARM, Log(runs), candidates=("load_friction", "coulomb_friction"))


def test_a_name_that_the_runs_kept_apart_contradict_is_unknown_with_a_sentence() -> None:
    outcome = contradicted()
    assert outcome.split.report_runs == reporting()
    assert outcome.finding.effects == ()
    assert outcome.finding.unknown is not None
    assert outcome.finding.gap_after == outcome.finding.gap_before
    assert outcome.finding.unknown.nearest == LOAD_2
    assert any("not the held-out ones" in text for text in outcome.warnings)


def test_what_one_of_a_set_explains_is_not_said_to_follow_nothing() -> None:
    one_way = Log(log_of(ARM, link_friction).runs[:1])
    finding = examine(ARM, one_way, candidates=("load_friction", "coulomb_friction")).finding
    assert [set(names) for names in finding.ambiguous] == [{LOAD_2, EffectName("coulomb_friction", 2)}]
    assert finding.unknown is None


def test_no_file_predicts_worse_than_the_given_arm_whatever_the_fit_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """What bends is no straight line: what a fit says of the runs kept apart need not be what the file does to them."""
    monkeypatch.setattr(find, "validated", lambda fit, reporting: (fit, []))
    monkeypatch.setattr(answer, "_against", lambda fit, member, reporting: None)
    monkeypatch.setattr(answer, "dominant_names", lambda fit, names, corrected, reporting: list(names))
    outcome = contradicted()
    assert outcome.finding.effects == ()
    assert outcome.finding.gap_after == outcome.finding.gap_before
    assert f"{LOAD_2} improves the fitted runs, but not the held-out ones: ignored" in outcome.warnings


@pytest.mark.parametrize(("worth", "is_against"), [(-3e-4, False), (-0.3, True), (0.2, False)])
def test_runs_kept_apart_that_do_not_speak_of_a_name_do_not_contradict_it(
    worth: float, is_against: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stribeck friction shows near rest: fast runs change with it by less than any noise."""
    monkeypatch.setattr(answer, "_worth", lambda fit, number, reporting: worth)
    member: Any = SimpleNamespace(term=SimpleNamespace(key=LOAD_2, is_common=False), departure=0.0, number=0)
    nothing: Any = None
    assert (answer._against(nothing, member, nothing) is not None) == is_against


def test_what_decides_without_repeats_is_held_out_in_pieces_of_its_time() -> None:
    """Of two runs one reports; a name must help to predict a part of the other that it was not fitted to."""
    whole = log_of(ARM)
    recording = prepare(ARM, Log((whole.runs[0], whole.runs[-1])))
    parts = split(recording, ResidualRows(Physics(ARM, recording), known_laws(ARM)).table)
    assert len(parts.report_runs) == 1
    assert len(parts.groups) == 4
    assert np.array_equal(np.sum(parts.groups, axis=0), parts.deciding.astype(int))
    assert all(group.any() for group in parts.groups)
