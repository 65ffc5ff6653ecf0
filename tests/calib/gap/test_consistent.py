"""One finding does not contradict itself, and a page that fails loses nothing."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import pytest

from calib.gap import report
from calib.gap.finding import EffectName, GapFinding, NamedEffect, Unknown
from calib.gap.report import GapOutcome
from calib.gap.words import in_words
from calib.gap.workflow import Recordings, consistent, write_gap
from control.model.description import load_arm

DRAG, OIL, PLAY = (EffectName("coulomb_friction", 1), EffectName("viscous_friction", 1), EffectName("backlash", 2))
FOUND = GapFinding(
    arm="right",
    data=("log.csv",),
    noise_floor={"current_A": 0.01, "tip_m": 1e-4, "q_rad": 1e-6},
    gap_before=60.0,
    gap_after=1.1,
    before_si={"current_A": 0.6, "tip_m": 1e-4, "q_rad": 1e-2},
    after_si={"current_A": 0.011, "tip_m": 1e-4, "q_rad": 1e-2},
    effects=(NamedEffect(OIL, {"coefficient_Nm_s_rad": (0.5, 0.01)}, 1.1),),
)


def test_what_is_named_stands_in_no_set_of_what_it_may_be() -> None:
    found = consistent(dataclasses.replace(FOUND, ambiguous=((DRAG, OIL), (DRAG, PLAY))))
    assert found.ambiguous == ((DRAG, PLAY),)
    assert not any("distinguish" in text and str(OIL) in text for text in in_words(found))


def test_a_gap_that_nothing_accounts_for_is_no_silence() -> None:
    left = dataclasses.replace(FOUND, gap_after=9.6, after_si={"current_A": 0.13, "tip_m": 1e-4, "q_rad": 1e-2})
    found = consistent(left)
    assert found.unknown == Unknown("the motors' currents, 13.0 times the noise", None, 0.0)
    assert found.next_experiment is not None
    bare = consistent(dataclasses.replace(left, effects=()))
    assert not any("no known effect is needed" in text for text in in_words(bare))


def test_what_is_at_the_noise_or_said_already_stays_as_it_is() -> None:
    assert consistent(FOUND) == FOUND
    said = dataclasses.replace(FOUND, gap_after=9.6, unknown=Unknown("the tip", PLAY, 0.5))
    assert consistent(said) == said


def test_an_unknown_that_an_effect_all_but_explains_is_not_called_explained() -> None:
    near = dataclasses.replace(FOUND, unknown=Unknown("the tip", PLAY, 1.0))
    assert any("explains 99 % of the residual, but not the rest" in text for text in in_words(near))
    own = dataclasses.replace(FOUND, unknown=Unknown(f"{PLAY} departs too far from its law", PLAY, 1.0))
    assert not any("nearest" in text for text in in_words(own))


def test_a_picture_that_fails_loses_no_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: object) -> None:
        raise ValueError("Axis limits cannot be NaN or Inf")

    monkeypatch.setattr(report, "dynamic_sections", broken)
    outcome = GapOutcome(FOUND, None, SimpleNamespace(finding=FOUND), ())  # type: ignore[arg-type]
    write_gap(outcome, load_arm("right"), Recordings(None, None, (), (), ()), tmp_path / "out")
    assert (tmp_path / "out" / "gap.json").exists()
    assert (tmp_path / "out" / "arm.toml").exists()
    page = (tmp_path / "out" / "report.html").read_text()
    assert "could not be drawn (ValueError: Axis limits cannot be NaN or Inf)" in page
    assert "viscous_friction on joint 1" in page
