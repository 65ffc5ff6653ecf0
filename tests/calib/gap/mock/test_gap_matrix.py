"""The score counts what it says: which column an answer falls into, and which figures follow."""

from __future__ import annotations

import math

import pytest

from benchmarks.gap.matrix import Answer, Hidden, Truth, answer, figures, matrix, score_text
from calib.gap.finding import EffectName, GapFinding, NamedEffect, Unknown

PLAY1, PLAY2, SOFT2 = EffectName("backlash", 1), EffectName("backlash", 2), EffectName("joint_compliance", 2)
GEOMETRY = EffectName("link_geometry")
ONE = Truth((Hidden(PLAY1, {"width_rad": 0.004}),))
TWO = Truth((*ONE.hidden, Hidden(SOFT2, {"stiffness_Nm_rad": 500.0})))
NOTHING, OFF = Truth(()), Truth(ONE.hidden, is_listed=False)


def said(
    *named: EffectName, sets: tuple[tuple[EffectName, ...], ...] = (), unknown: bool = False, value: float = 0.0042
) -> GapFinding:
    effects = tuple(NamedEffect(n, {"width_rad": (value, 1e-4), "stiffness_Nm_rad": (500.0, 5.0)}, 1.0) for n in named)
    what = Unknown("joint 1", None, 0.0) if unknown else None
    return GapFinding("right", (), {}, 5.0, 1.05, {}, {}, effects, sets, what)


def scored(truth: Truth, found: GapFinding, *could: EffectName) -> Answer:
    return answer("a case", truth, found, could, 2.0)


@pytest.mark.parametrize(
    ("truth", "found", "column"),
    [
        (ONE, said(PLAY1), "right"),
        (ONE, said(PLAY1, unknown=True), "doubts"),
        (ONE, said(PLAY1, sets=((SOFT2, PLAY2),)), "doubts"),
        (ONE, said(PLAY2), "wrong"),
        (ONE, said(PLAY1, SOFT2), "wrong"),
        (ONE, said(sets=((PLAY1, SOFT2),)), "set with"),
        (ONE, said(sets=((PLAY2, SOFT2),)), "set w/o"),
        (ONE, said(unknown=True), "unknown"),
        (ONE, said(), "nothing"),
        (TWO, said(PLAY1, SOFT2), "right"),
        (TWO, said(SOFT2), "part"),
        (NOTHING, said(), "nothing"),
        (NOTHING, said(PLAY1), "wrong"),
        (NOTHING, said(unknown=True), "unknown"),
        (OFF, said(unknown=True), "unknown"),
        (OFF, said(PLAY1), "wrong"),
        (OFF, said(sets=((PLAY2, SOFT2),)), "set w/o"),
    ],
)
def test_an_answer_falls_into_its_column(truth: Truth, found: GapFinding, column: str) -> None:
    one = scored(truth, found)
    assert one.column == column
    assert column in matrix([one])


def test_geometry_is_a_wrong_name_only_where_it_is_not_off() -> None:
    assert scored(NOTHING, said(GEOMETRY)).column == "wrong"
    assert scored(Truth((), is_crooked=True), said(GEOMETRY)).column == "nothing"
    assert scored(Truth(ONE.hidden, is_crooked=True), said(GEOMETRY, PLAY1)).column == "right"


def test_the_worst_parameter_counts_and_phases_count_within_a_turn() -> None:
    assert scored(ONE, said(PLAY1)).error == pytest.approx(0.05)
    phased = Truth((Hidden(PLAY1, {"phase_rad": 3.1, "damping_Nm_s_rad": 1.0}),))
    found = said(PLAY1)
    with_phase = NamedEffect(PLAY1, {"phase_rad": (3.1 - 2.0 * math.pi + 0.02, 0.01)}, 1.0)
    turned = GapFinding("right", (), {}, 5.0, 1.0, {}, {}, (with_phase,))
    assert scored(phased, turned).error == pytest.approx(0.02)
    assert scored(phased, found).error == 1.0  # named, but the parameter is not given


def test_figures_stand_among_nameable_cases_and_over_all_of_them() -> None:
    answers = [
        scored(ONE, said(PLAY1), PLAY1),
        scored(ONE, said(unknown=True)),  # not called nameable beforehand
        scored(NOTHING, said()),
        scored(NOTHING, said(unknown=True)),
        scored(OFF, said(PLAY2)),
        scored(OFF, said(unknown=True)),
    ]
    text = figures(answers, 1.1)
    assert "nameable: effect and joint right in 1 of 1 (100%), exact set in 1 of 1 (100%)" in text
    assert "all: 1 of 2 (50%), exact 1 of 2 (50%)" in text
    assert "no name in 2 of 2; neither name, set nor unknown in 1" in text
    assert "no wrong name in 1 of 2; unknown in 1" in text
    assert "within 10% in 1 of 1" in text


def test_a_score_of_nothing_is_text_too() -> None:
    assert "0 cases" in score_text("none", [], 1.1)
