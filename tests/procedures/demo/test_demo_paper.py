"""The paper's experiment on an arm without dynamics: what each identification is worth, and what is written about it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from calib.arrays import norms
from console.main import main
from control.kinematics.kinematics import ForwardKinematics
from control.model import table as tables
from control.model.description import load_arm
from procedures.demo import paper
from procedures.demo.paper import PaperOutcome
from procedures.demo.paper_models import BACKLASH, FREE, OTHER, SETUPS, TILTS, commands, free_poses, verification_targets
from procedures.demo.paper_page import improvement, table_text
from tests.procedures.demo.quasi_static import QuasiStaticBench

ARM = load_arm("right")
WIDTH_rad = (0.005, 0.003, 0.006)
# Within the bounds, and some 27 mm at the table: a turn of joint 1 and a lift of joint 2 do most of it.
DEVIATION = np.array(
    [[0.003, 0.03, 0.001, 0.01], [-0.002, 0.025, -0.003, 0.01], [0.001, 0.01, 0.002, -0.01], [0.002, 0.0, 0.001, 0.0]]
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("paper")


@pytest.fixture(scope="module")
def steps() -> list[tuple[str, float]]:
    return []


@pytest.fixture(scope="module")
def outcome(folder: Path, steps: list[tuple[str, float]]) -> PaperOutcome:
    bench = QuasiStaticBench(ARM, DEVIATION, WIDTH_rad)
    return paper.run(ARM, bench, folder, lambda what, done: steps.append((what, done)))


def mean_mm(outcome: PaperOutcome, name: str | None) -> float:
    return 1e3 * float(norms(outcome.replay.error_m(name)).mean())


def test_geometry_alone_leaves_the_play_and_backlash_in_the_model_takes_it(outcome: PaperOutcome) -> None:
    assert 15.0 < mean_mm(outcome, None) < 40.0
    for name in (*SETUPS, TILTS, FREE):
        assert mean_mm(outcome, name) > 0.5  # half of 5 mrad of play at half a metre is 1.25 mm
        assert mean_mm(outcome, name) < 0.25 * mean_mm(outcome, None)
    assert mean_mm(outcome, BACKLASH) < 0.2  # the camera's noise, 0.1 s of it, is 0.07 mm


def test_every_width_comes_back(outcome: PaperOutcome) -> None:
    found = [e.parameters["width_rad"] for e in outcome.replay.models[-1].backlash]
    assert found == pytest.approx(WIDTH_rad, rel=0.1)


def test_the_table_alone_is_said_not_to_show_the_play(outcome: PaperOutcome) -> None:
    text = " ".join(outcome.replay.table_says)
    assert all(f"backlash of joint {joint}" in text for joint in (1, 2))
    assert "cannot be distinguished from the joint's zero" in text


def test_no_model_but_that_with_backlash_knows_of_play(outcome: PaperOutcome) -> None:
    assert [len(model.backlash) for model in outcome.replay.models] == [0, 0, 0, 0, 0, 3]


def test_what_is_written_can_be_read_again(outcome: PaperOutcome, folder: Path) -> None:
    figures = json.loads(outcome.figures.read_text("utf-8"))
    assert figures["format"] == "paper-replay/1"
    assert figures["published"]["improved_percent"] == {"normal": 38.789, "roll": 28.866, "pitch": 17.292}
    own = figures["identified"]["roll"]["verified"]["roll"]
    assert own["improved_percent"] == pytest.approx(outcome.replay.of("roll", "roll").percent)
    arm = load_arm(folder / "arm_with_backlash.toml")
    assert [e.effect for e in arm.effects] == ["backlash"] * 3
    assert np.allclose(arm.dh, outcome.replay.models[-1].arm.dh)
    html = outcome.report.read_text("utf-8")
    assert html.count("<svg") == 4
    assert "38.8 %" in html
    assert not re.search(r"""(?:src|href)\s*=\s*["'](?!#|data:)""", html)


def test_progress_rises_from_nothing_to_all(outcome: PaperOutcome, steps: list[tuple[str, float]]) -> None:
    shares = [done for _, done in steps]
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0.0, 1.0)


def test_the_table_has_a_row_for_every_identification_and_the_published_one(outcome: PaperOutcome) -> None:
    text = table_text(outcome.replay)
    for name in (*SETUPS, TILTS, FREE, BACKLASH, "published", OTHER):
        assert name in text


def test_commands_without_play_put_the_models_tip_on_its_target() -> None:
    targets = verification_targets(tables.table_of(ARM))
    poses = commands(ARM, targets, ARM.rest.q_rad if ARM.rest else (0.0, 0.0, 0.0))
    tips = ForwardKinematics(ARM).tips([pose.q_rad for pose in poses])
    assert np.allclose(tips, [tip for _, _, tip in targets], atol=1e-8)


def test_free_poses_are_in_range_and_gravity_turns_round_among_them() -> None:
    q = free_poses(ARM)
    lower, upper = np.array(ARM.limits_rad).T
    assert ((q > lower) & (q < upper)).all()
    assert np.array_equal(q, free_poses(ARM))
    assert min(np.linalg.norm(a - b) for k, a in enumerate(q) for b in q[:k]) > 0.2


def test_an_improvements_interval_covers_the_true_ratio() -> None:
    rng = np.random.default_rng(5)
    covered = 0
    for _ in range(400):
        before = rng.uniform(20.0, 30.0, 6)
        after = 0.6 * before + rng.normal(0.0, 1.0, 6)
        found = improvement(before, after)
        covered += abs(found.percent - 40.0) < found.percent_half
    assert 0.92 < covered / 400 < 0.98  # 95 % within three standard deviations of 400 trials


def test_a_single_point_has_no_interval() -> None:
    found = improvement(np.array([10.0]), np.array([5.0]))
    assert found.percent == pytest.approx(50.0)
    assert np.isnan(found.percent_half)


def test_another_demo_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["demo", "papers"])
    assert ended.value.code == 2
    assert "job" in capsys.readouterr().err
