"""Verification figures against hand-worked ones; the report stands alone and says what it should."""

import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.calibration.chains import REFERENCE, REFERENCE_DH, board_session
from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.parallel_axes import with_tilt_behind
from calib.calibration import verification_json, write_calibrated_arm, write_calibration_json
from calib.errors import CalibrationError
from calib.report.page import list_section, svg
from calib.report.pictures import SAMPLES_DRAWN, thinned
from calib.report.report import ReportData, dh_section, parameters_section, report_html, write_report
from calib.results import InputFile, Provenance, input_file
from calib.validation.holdout import Fold, HeldOut
from calib.validation.statistics import PairedFinding, difference, student_t, summarise
from calib.validation.verify import (
    PARTS,
    Track,
    TrackPair,
    compare,
    compare_repeated,
    compare_tracks,
    comparison_text,
    findings,
    parts_of,
)
from control.errors import ArmError
from control.model.description import load_arm
from tests.calib.arms import identified


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
    comparison = comparison_of([26.85] * 4, [16.436, 16.436, 22.207, 22.207], ["normal", "normal", "pitch", "pitch"])
    assert comparison.of("normal").improvement_percent == pytest.approx(38.786, abs=0.01)
    assert comparison.of("pitch").improvement_percent == pytest.approx(17.292, abs=0.01)
    assert [entry.setup for entry in comparison.by_setup()] == ["normal", "pitch", "all"]
    assert comparison.of("all").before.count == 4


def test_a_paired_difference_is_that_of_a_worked_example() -> None:
    """Differences 1, 2, 3 mm: mean 2, sd 1, t(2; 0.975) = 4.30265, so 2 +- 2.48414 mm: not more than chance."""
    found = difference(np.array([0.011, 0.012, 0.013]), np.array([0.010, 0.010, 0.010]))
    assert found.mean_m == pytest.approx(0.002)
    assert found.half_width_m == pytest.approx(0.00248414, rel=1e-5)
    assert found.finding is PairedFinding.NOTHING
    assert found.in_words() == "no significant difference: 2.0 mm [-0.5, 4.5] (95 %)"


def test_a_finding_needs_the_whole_interval() -> None:
    before = np.array([0.0201, 0.0203, 0.0205, 0.0207])
    better = difference(before, before - 0.0123 + np.array([0.0, 1e-4, -1e-4, 0.0]))
    assert better.finding is PairedFinding.BETTER
    assert better.in_words() == "better by 12.30 mm [12.17, 12.43] (95 %)"
    worse = difference(before, before + 0.0123 + np.array([0.0, 1e-4, -1e-4, 0.0]))
    assert worse.finding is PairedFinding.WORSE
    assert worse.in_words() == "worse by 12.30 mm [12.17, 12.43] (95 %)"
    alone = difference(before[:1], before[:1] - 0.01)
    assert alone.finding is PairedFinding.NOTHING
    assert "too few for an interval" in alone.in_words()
    same = difference(before, before)
    assert same.finding is PairedFinding.NOTHING
    assert same.in_words().startswith("no significant difference")


def test_intervals_hold_what_they_promise() -> None:
    """6 points a setup, as in the paper: 95 % intervals of paired differences cover the truth 94 to 96 times in 100."""
    rng = np.random.default_rng(8)
    points = rng.normal(0.02, 0.003, (20_000, 6))
    changes = 0.004 + rng.normal(0.0, 0.001, (20_000, 6))
    found = [difference(b, b - c) for b, c in zip(points, changes, strict=True)]
    covered = np.mean([d.lower_m <= 0.004 <= d.upper_m for d in found])
    assert 0.94 < covered < 0.96


def test_repeats_at_a_point_become_its_mean_and_interval() -> None:
    """Along the mean error (0, 3, 4) / 5 the repeats are 4, 5, 6 mm: 5 +- 2.484 mm; across it they do not count."""
    along = np.array([0.0, 0.6, 0.8])
    across = np.array([1.0, 0.0, 0.0])
    errors = 1e-3 * np.array([4 * along + across, 5 * along - 2 * across, 6 * along + across])
    tips = np.tile([0.5, 0.1, 0.0], (3, 1))
    comparison = compare_repeated(["n"] * 3, ["1"] * 3, tips, errors, 0.1 * errors)
    assert comparison.point == ("1",)
    np.testing.assert_allclose(comparison.before_m, [5e-3 * along], atol=1e-12)
    assert comparison.before_half_width_m[0] == pytest.approx(student_t(2) * 1e-3 / np.sqrt(3.0))
    assert comparison.after_half_width_m[0] == pytest.approx(0.1 * comparison.before_half_width_m[0])
    single = compare_repeated(["n"], ["1"], tips[:1], errors[:1], errors[:1])
    assert np.isnan(single.before_half_width_m[0])


def circle_track(name: str, offset_m: float, count: int = 5000) -> Track:
    turn = np.linspace(0.0, 2 * np.pi, count)
    planned = np.column_stack((0.5 + 0.09 * np.cos(turn), 0.09 * np.sin(turn), 0 * turn))
    measured = planned + offset_m
    measured[::4] = np.nan
    return Track(name, turn, planned, measured)


def test_a_path_counts_as_its_parts_not_as_its_frames() -> None:
    pair = TrackPair("circle", "normal", circle_track("circle", 0.004), circle_track("circle", 0.0004, 3000))
    comparison = compare_tracks([pair])
    assert comparison is not None
    assert len(comparison.point) == PARTS
    assert comparison.point[0] == f"circle, part 1 of {PARTS}"
    np.testing.assert_allclose(comparison.before_m, 0.004)
    np.testing.assert_allclose(comparison.after_m, 0.0004)
    assert compare_tracks([]) is None
    planned, _ = parts_of(pair.before)
    middles = (np.arange(PARTS) + 0.5) * 2 * np.pi / PARTS
    np.testing.assert_allclose(np.arctan2(planned[:, 1], planned[:, 0] - 0.5) % (2 * np.pi), middles, atol=2e-3)


def test_parts_where_the_tip_was_hidden_are_left_out() -> None:
    hidden = circle_track("circle", 0.004)
    measured = hidden.measured_m.copy()
    measured[:1000] = np.nan  # a fifth of the circle: parts 1 and 2 whole, part 3 in part
    pair = TrackPair("circle", "roll", Track("circle", hidden.time_s, hidden.planned_m, measured), hidden)
    comparison = compare_tracks([pair])
    assert comparison is not None
    assert comparison.point[0] == f"circle, part 3 of {PARTS}"
    assert len(comparison.point) == PARTS - 2


def test_the_text_tables_name_setups_and_units() -> None:
    comparison = comparison_of([10.0, 12.0], [1.0, 2.0], ["normal", "normal"])
    text = comparison_text(comparison)
    assert "[mm]" in text
    assert "86.4 %" in text
    assert len({len(line) for line in text.splitlines()}) == 1
    assert findings(comparison) == ("normal: better by 9.5 mm [3.1, 15.9] (95 %)",)


def test_what_does_not_belong_together_is_refused() -> None:
    with pytest.raises(CalibrationError, match="equal shapes"):
        compare(["a"], ["1"], np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(CalibrationError, match="not a finite number"):
        compare(["a"], ["1"], np.zeros((1, 3)), np.full((1, 3), np.nan), np.zeros((1, 3)))


@pytest.fixture(scope="module")
def result():
    _, q, tips, setups = board_session(np.random.default_rng(4))
    identification = identified(REFERENCE, REFERENCE_DH, q, tips, starts_count=1)
    names = [str(k % 33 + 1) for k in range(len(q))]
    return identification, compare(setups, names, tips, identification.error_before_m, identification.error_after_m)


def full_report(result, tmp_path: Path) -> ReportData:
    found, comparison = result
    (tmp_path / "points.csv").write_text("x")
    pair = TrackPair("circle", "normal", circle_track("circle", 0.02), circle_track("circle", 0.0004))
    nominal = load_arm("right")
    return ReportData(
        title="Report <of> a test",
        arm="right & left",
        made=Provenance((input_file(tmp_path / "points.csv", "table session"),), "2026-01-01", "0.1.0"),
        steps=("moved", "measured"),
        paths=(pair,),
        identification=found,
        calibration=comparison,
        verification=comparison,
        arms=(nominal, nominal.with_dh(found.dh)),
        notes=("nothing",),
        verdict=("a <good> one",),
        sections=(list_section("Held out", ["1 & 2"]), list_section("Outliers", ["point <7>"])),
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
    assert page.count("<svg") == page.count("</svg>") == page.count(' style="max-width: ') == 7  # their text is of one size
    assert len(page) < 2_000_000


def test_the_report_says_what_was_found(written_page: str) -> None:
    page = written_page
    assert "Report &lt;of&gt; a test" in page
    assert "right &amp; left" in page
    assert "2d711642b726b04401627ca9fbac32f5c8530fb1903cc4db02258717921a4881" in page  # SHA-256 of "x"
    assert "determine 10 of 16 parameters" in page
    assert "a &lt;good&gt; one" in page
    assert "<h2>Held out</h2><ul><li>1 &amp; 2</li></ul>" in page
    assert "point &lt;7&gt;" in page
    assert "better by" in page
    for name in ("d1", "theta2", "L3", "alpha4"):
        assert f"<td>{name}</td>" in page


def test_the_same_inputs_make_the_same_page(result, written_page: str, tmp_path: Path) -> None:
    assert report_html(full_report(result, tmp_path)) == written_page


def test_the_large_figures_of_a_calibration_are_those_of_points_that_it_did_not_use(result) -> None:
    found, comparison = result
    held = HeldOut("2", (Fold("every 2nd", (0, 1), "error", np.full(2, 0.0123), np.full(2, 0.00045)),))
    made = Provenance((), "d", "v")
    report = ReportData("t", "a", made, ("did it",), identification=found, calibration=comparison, held=held)
    large = re.findall(r'<div class="tile"><b class="\w*">(.*?)</b>', report_html(report))
    assert large[:3] == ["12.30 mm", "0.45 mm", "96.3 %"]


def test_a_report_with_nothing_but_steps_is_a_page() -> None:
    page = report_html(ReportData("t", "a", Provenance((), "d", "v"), ("did it",)))
    assert "did it" in page
    assert "<svg" not in page


def test_parameters_of_any_unit_and_bound_have_a_row(result) -> None:
    """What an identification may free besides DH: frames without bounds, ratios without unit."""
    found, _ = result
    one = found.estimates[0]
    others = [
        replace(one, parameter=replace(one.parameter, name=name, unit=unit, bound=bound))
        for name, unit, bound in (
            ("base_rx", "rad", np.inf),
            ("tool_x_m", "m", 0.005),
            ("encoder_scale2", "1", 0.01),
            ("compliance2", "rad/Nm", np.inf),
        )
    ]
    html = parameters_section(replace(found, estimates=tuple(others))).html
    assert "<td>base_rx</td><td>deg</td>" in html
    assert "<td>none</td>" in html
    assert "<td>tool_x_m</td><td>mm</td>" in html
    assert "<td>encoder_scale2</td><td></td>" in html
    assert "<td>compliance2</td><td>rad/Nm</td>" in html


def test_a_track_is_drawn_where_the_tip_was_seen() -> None:
    time_s, path = np.arange(9000.0), np.zeros((9000, 3))
    seen = np.where(np.arange(9000)[:, None] % 2, np.nan, path)
    assert 0.5 * SAMPLES_DRAWN < len(thinned(Track("t", time_s, path, seen)).time_s) <= SAMPLES_DRAWN
    with pytest.raises(CalibrationError, match="never measured"):
        thinned(Track("t", time_s, path, np.full_like(path, np.nan)))


def test_the_calibrated_arm_says_where_it_comes_from_and_replaces_nothing(result, tmp_path: Path) -> None:
    found, _ = result
    nominal, path = load_arm("right"), tmp_path / "arm.toml"
    made = Provenance((InputFile("points.csv", "ab" * 32, "points"),), "2026-01-01", "0.1.0")
    write_calibrated_arm(path, nominal, found, made)
    back = load_arm(path)
    assert np.array_equal(back.dh, found.dh)
    assert back.calibration is not None
    assert back.calibration.inputs == {"points.csv": "ab" * 32}
    assert tomllib.loads(path.read_text())["calibration"]["from"] == "right.toml"
    with pytest.raises(ArmError, match="never overwritten"):
        write_calibrated_arm(path, nominal, found, made)


def test_calibration_json_is_plain_json_with_every_parameter(result, tmp_path: Path) -> None:
    found, comparison = result
    made = Provenance((), "2026-01-01", "0.1.0")
    write_calibration_json(tmp_path / "c.json", "right", found, made, verification_json(comparison))
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


def test_the_rows_of_an_arm_with_a_tilt_stand_beside_those_that_it_had() -> None:
    """`gap` adds a fixed row where two axes are not parallel: the table shows it on both sides, before and after."""
    arm = load_arm("right")
    html = dh_section(arm, with_tilt_behind(arm, 2)).html
    assert html == dh_section(with_tilt_behind(arm, 2), arm).html
    assert "link 4" in html
    assert "have other rows" in dh_section(arm, load_arm("so101")).html


def test_a_cloud_of_dots_is_pixels_and_few_dots_stay_sharp() -> None:
    def drawn(count: int) -> str:
        at = np.linspace(0.0, 1.0, count)
        return svg((4.0, 3.0), lambda figure: figure.subplots().plot(at, at**2, "o"))

    few, many = drawn(100), drawn(20_000)
    assert few.count("<use") > 100
    assert "<image" not in few
    assert many.count("<image") == 1
    assert len(many) < 100_000
