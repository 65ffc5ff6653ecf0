"""Verification figures against hand-worked ones; the report stands alone and says what it should."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from calib_arms import REFERENCE, REFERENCE_DH, board_session, identified

from calib.errors import CalibrationError
from calib.identify import ArmModel
from calib.outcome import write_calibrated_arm, write_calibration_json
from calib.pictures import thinned
from calib.points import make_points
from calib.report import report_html, write_report
from calib.report_data import ReportData, Track, input_file
from calib.verify import compare, compare_points, comparison_text, points_text, summarise
from control.errors import ArmError
from control.model.description import load_arm


def test_figures_are_those_of_a_worked_example() -> None:
    """Errors 1, 2, 3, 4 mm: mean 2.5, sd 1.29099, t(3; 0.975) = 3.18245, so the mean is 2.5 +- 2.05426 mm."""
    summary = summarise(np.array([0.001, 0.002, 0.003, 0.004]))
    assert summary.count == 4
    assert summary.mean_m == pytest.approx(0.0025)
    assert summary.rms_m == pytest.approx(np.sqrt(7.5) * 1e-3)
    assert summary.max_m == 0.004
    assert summary.sd_m == pytest.approx(0.00129099, rel=1e-5)
    assert summary.mean_half_width_m == pytest.approx(0.00205426, rel=1e-5)


def test_one_point_has_no_interval() -> None:
    assert np.isnan(summarise(np.array([0.001])).mean_half_width_m)


def comparison_of(before_mm, after_mm, setups):
    directions = np.eye(3)[np.arange(len(setups)) % 3]
    before, after = (1e-3 * np.array(e)[:, None] * directions for e in (before_mm, after_mm))
    return compare(setups, [str(k) for k in range(len(setups))], directions * 0.1, before, after)


def test_improvement_is_of_the_means_per_setup() -> None:
    """The paper's own figures: 26.850 to 16.436 mm is 38.79 % better, to 22.207 mm 17.29 %."""
    found = comparison_of(
        [26.85] * 4, [16.436, 16.436, 22.207, 22.207], ["normal", "normal", "pitch", "pitch"]
    )
    assert found.of("normal").improvement_percent == pytest.approx(38.786, abs=0.01)
    assert found.of("pitch").improvement_percent == pytest.approx(17.292, abs=0.01)
    assert [entry.setup for entry in found.by_setup()] == ["normal", "pitch", "all"]
    assert found.of("all").before.count == 4


def test_predictions_are_compared_where_the_tip_was_seen() -> None:
    true, q, tips, setups = board_session(np.random.default_rng(4), ("roll",), noise_m=0.0)
    tips[3] = np.nan
    points = make_points(setups, [str(k) for k in range(33)], [1] * 33, q, tips)
    found = compare_points(REFERENCE, REFERENCE_DH, true, points)
    assert len(found.point) == 32
    assert "3" not in found.point
    assert found.of("roll").before.mean_m > 0.005
    assert found.of("roll").after.max_m < 1e-9


def test_the_text_tables_name_setups_and_units() -> None:
    found = comparison_of([10.0, 12.0], [1.0, 2.0], ["normal", "normal"])
    text = comparison_text(found)
    assert "[mm]" in text
    assert "86.4 %" in text
    assert len({len(line) for line in text.splitlines()}) == 1
    assert "12.000" in points_text(found)


def test_what_does_not_belong_together_is_refused() -> None:
    with pytest.raises(CalibrationError, match="different shape"):
        compare(["a"], ["1"], np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(CalibrationError, match="not a finite number"):
        compare(["a"], ["1"], np.zeros((1, 3)), np.full((1, 3), np.nan), np.zeros((1, 3)))


@pytest.fixture(scope="module")
def result():
    _, q, tips, setups = board_session(np.random.default_rng(4))
    found = identified(REFERENCE, REFERENCE_DH, q, tips, starts_count=1)
    names = [str(k % 33 + 1) for k in range(len(q))]
    return found, compare(setups, names, tips, found.error_before_m, found.error_after_m)


def full_report(result, tmp_path: Path) -> ReportData:
    found, comparison = result
    (tmp_path / "points.csv").write_text("x")
    turn = np.linspace(0.0, 2 * np.pi, 5000)
    planned = np.column_stack((0.5 + 0.09 * np.cos(turn), 0.09 * np.sin(turn), 0 * turn))
    measured = planned + 0.0004
    measured[::4] = np.nan
    return ReportData(
        title="Report <of> a test",
        arm="right & left",
        date="2026-01-01",
        program_version="0.1.0",
        steps=("moved", "measured"),
        inputs=(input_file(tmp_path / "points.csv", "table session"),),
        tracks=(Track("circle", turn, planned, measured),),
        identification=found,
        calibration=comparison,
        verification=comparison,
        notes=("nothing",),
    )


@pytest.fixture(scope="module")
def written_page(result, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A report as it was written to disk; drawing one takes seconds."""
    folder = tmp_path_factory.mktemp("report")
    write_report(folder / "out" / "report.html", full_report(result, folder))
    return (folder / "out" / "report.html").read_text()


def test_the_report_stands_alone(written_page: str) -> None:
    page = written_page
    assert not re.search(r'(?:src|href)="(?!#)', page)
    assert not re.search(r"url\((?!#)|@import|<script|<link", page)
    assert page.count("<svg") == page.count("</svg>") == 7
    assert len(page) < 2_000_000


def test_the_report_says_what_was_found(written_page: str) -> None:
    page = written_page
    assert "Report &lt;of&gt; a test" in page
    assert "right &amp; left" in page
    assert "2d711642b726b04401627ca9fbac32f5c8530fb1903cc4db02258717921a4881" in page  # SHA-256 of "x"
    assert "determine 10 of 16 parameters" in page
    for name in ("d1", "theta2", "L3", "alpha4"):
        assert f"<td>{name}</td>" in page


def test_the_same_inputs_make_the_same_page(result, written_page: str, tmp_path: Path) -> None:
    assert report_html(full_report(result, tmp_path)) == written_page


def test_a_report_with_nothing_but_steps_is_a_page() -> None:
    page = report_html(ReportData("t", "a", "d", "v", ("did it",)))
    assert "did it" in page
    assert "<svg" not in page


def test_a_track_is_drawn_where_the_tip_was_seen() -> None:
    time_s, path = np.arange(9000.0), np.zeros((9000, 3))
    seen = np.where(np.arange(9000)[:, None] % 2, np.nan, path)
    assert len(thinned(Track("t", time_s, path, seen)).time_s) == 1500
    with pytest.raises(CalibrationError, match="measured at no time"):
        thinned(Track("t", time_s, path, np.full_like(path, np.nan)))


def test_the_calibrated_arm_says_where_it_comes_from_and_replaces_nothing(result, tmp_path: Path) -> None:
    found, _ = result
    nominal, path = load_arm("right"), tmp_path / "arm.toml"
    write_calibrated_arm(path, nominal, found, {"points.csv": "ab" * 32}, "2026-01-01", "0.1.0")
    back = load_arm(path)
    assert np.array_equal(back.dh, found.dh)
    assert back.calibration is not None
    assert back.calibration.inputs == {"points.csv": "ab" * 32}
    assert tomllib.loads(path.read_text())["calibration"]["from"] == "right.toml"
    with pytest.raises(ArmError, match="never overwritten"):
        write_calibrated_arm(path, nominal, found, {}, "2026-01-01", "0.1.0")


def test_calibration_json_is_plain_json_with_every_parameter(result, tmp_path: Path) -> None:
    found, comparison = result
    write_calibration_json(tmp_path / "c.json", "right", found, {}, "2026-01-01", "0.1.0", comparison)
    content = json.loads((tmp_path / "c.json").read_text())
    assert content["format"] == "calibration/1"
    assert len(content["parameters"]) == 16
    assert content["rank"] == 10
    assert content["verification"]["all"]["improvement_percent"] > 90.0


def test_the_arms_own_kinematics_serve_identification() -> None:
    """control.model against the plain chain of these tests."""
    model, q = ArmModel(load_arm("right")), np.random.default_rng(0).uniform(-1, 1, (50, 3))
    tips, jacobian, _ = model.slopes(REFERENCE_DH, q)
    wanted_tips, wanted_jacobian = REFERENCE.tips_and_dh_jacobian(REFERENCE_DH, q)
    np.testing.assert_allclose(model.tips(REFERENCE_DH, q), wanted_tips, atol=1e-14)
    np.testing.assert_allclose(tips, wanted_tips, atol=1e-14)
    np.testing.assert_allclose(jacobian, wanted_jacobian, atol=1e-14)
