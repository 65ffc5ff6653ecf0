"""What a verification concludes, what it writes, and whether it notices points that the calibration had used."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.points.points import Points, make_points
from calib.points.writer import write_points
from calib.report.report import Verification, write_verification_json, write_verification_report
from calib.results import Provenance
from calib.validation.verify import Track, TrackPair, Used, already_used, compare
from calib.validation.verify import USED_POSE_rad as SAME_POSE_rad
from control.model.arm import Arm, Calibration
from control.model.description import load_arm, save_arm

RIGHT = load_arm("right")


def verification(before_mm: dict[str, float], after_mm: dict[str, float], **changes: object) -> Verification:
    """Six points a setup with these mean errors, scattered by 0.1 mm."""
    setups = [setup for setup in before_mm for _ in range(6)]
    names = [str(k % 6) for k in range(len(setups))]
    x = np.array([1.0, 0.0, 0.0])
    scatter = np.random.default_rng(2).normal(0.0, 0.1, (2, len(setups)))
    before, after = (
        1e-3 * np.outer([mean[s] + e for s, e in zip(setups, noise, strict=True)], x)
        for mean, noise in ((before_mm, scatter[0]), (after_mm, scatter[1]))
    )
    tips = np.tile([0.5, 0.0, 0.05], (len(setups), 1))
    made = Verification(
        RIGHT, RIGHT, compare(setups, names, tips, before, after), (), ("looked",), (), True, Provenance((), "2026-01-01", "v")
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def test_the_verdict_is_on_all_points_and_names_a_setup_that_became_worse() -> None:
    """The paper's finding: better on the whole, and no better with the board pitched."""
    mixed = verification({"normal": 20.0, "pitch": 20.0}, {"normal": 10.0, "pitch": 20.5})
    assert not mixed.is_worse
    assert "better by" in mixed.verdict[0]
    assert mixed.verdict[1] == "Board pitch: worse, although the total is not."


def test_worse_by_more_than_chance_is_worse_and_by_chance_is_not() -> None:
    worse = verification({"normal": 10.0}, {"normal": 12.0})
    assert worse.is_worse
    assert "worse by 2.0" in worse.verdict[0]
    same = verification({"normal": 10.0}, {"normal": 10.0})
    assert not same.is_worse
    assert "neither better nor worse (no significant difference" in same.verdict[0]


def test_verify_json_holds_points_figures_and_verdict(tmp_path: Path) -> None:
    track = Track("circle", np.arange(50.0), np.linspace(0, 1, 150).reshape(50, 3), np.zeros((50, 3)))
    made = verification({"normal": 20.0}, {"normal": 1.0}, paths=(TrackPair("circle", "roll", track, track),), warnings=("mind",))
    write_verification_json(tmp_path / "new" / "verify.json", made)
    content = json.loads((tmp_path / "new" / "verify.json").read_text("utf-8"))
    assert content["format"] == "verify/1"
    assert content["verdict"]["finding"] == "better"
    assert content["verdict"]["is_worse"] is False
    assert content["by_setup"]["normal"]["difference"]["lower_m"] == pytest.approx(0.019, abs=2e-4)
    assert content["by_setup"]["normal"]["before"]["count"] == 6
    assert len(content["points"]) == 6
    assert content["points"][0]["before"]["half_width_m"] is None
    assert content["trajectories"]["by_setup"]["roll"]["difference"]["finding"] == "nothing"
    assert np.shape(content["dh"]["after"]) == (4, 4)
    assert content["warnings"] == ["mind"]


def test_the_report_shows_the_papers_tables_and_figures(tmp_path: Path) -> None:
    track = Track("circle", np.arange(50.0), np.linspace(0, 1, 150).reshape(50, 3), np.zeros((50, 3)))
    made = verification({"normal": 20.0}, {"normal": 1.0}, paths=(TrackPair("circle", "roll", track, track),))
    moved = replace(RIGHT, tool=replace(RIGHT.tool, position_m=(0.0, 0.0, 0.001)))
    write_verification_report(tmp_path / "report.html", replace(made, calibrated=moved))
    page = (tmp_path / "report.html").read_text("utf-8")
    for said in (
        "Error before and after",
        "Ideal and actual trajectories",
        "DH parameters before and after",
        "circle, board roll",
        "xy plane",
        "xz plane",
        "yz plane",
        "0.000, 0.000, 1.000 mm calibrated",
        "The calibrated arm is better by",
    ):
        assert said in page


def used_points(q_rad: np.ndarray) -> Points:
    m = len(q_rad)
    return make_points(["normal"] * m, [str(k) for k in range(m)], [1] * m, q_rad, np.zeros((m, 3)))


@pytest.fixture
def calibrated(tmp_path: Path) -> Arm:
    """An arm beside the points that it was calibrated with."""
    write_points(tmp_path / "points.csv", used_points(np.linspace(-0.5, 0.5, 12).reshape(4, 3)))
    digest = hashlib.sha256((tmp_path / "points.csv").read_bytes()).hexdigest()
    arm = replace(RIGHT, calibration=Calibration("right.toml", {"points.csv": digest}, "2026-01-01", "E2", "v"))
    save_arm(arm, tmp_path / "arm.toml")
    return load_arm(tmp_path / "arm.toml")


def test_the_file_that_the_arm_was_calibrated_with_is_recognised_by_its_hash(calibrated: Arm) -> None:
    assert calibrated.calibration is not None
    digest = calibrated.calibration.inputs["points.csv"]
    used = already_used(calibrated, np.zeros((2, 3)), digest)
    assert used.count == 2
    assert "these points are points.csv" in used.warnings[0]


def test_a_used_pose_is_recognised_in_another_file(calibrated: Arm) -> None:
    used = np.linspace(-0.5, 0.5, 12).reshape(4, 3)
    poses = np.vstack((used[1] + 0.9 * SAME_POSE_rad, used[2] + 1.1 * SAME_POSE_rad, used[3] + [0.0, 0.1, 0.0]))
    found = already_used(calibrated, poses, "0" * 64)
    assert found.count == 1
    assert "1 of 3 poses" in found.warnings[0]
    assert already_used(calibrated, poses[1:]) == Used(0, ())


def test_an_arm_file_among_the_inputs_has_no_poses_and_is_not_missed(calibrated: Arm) -> None:
    assert calibrated.calibration is not None
    inputs = {**calibrated.calibration.inputs, "right.toml": "0" * 64, "boards.json": "1" * 64}
    named = replace(calibrated, calibration=replace(calibrated.calibration, inputs=inputs))
    assert already_used(named, np.zeros((2, 3)) + 2.0) == Used(0, ())


def test_what_cannot_be_compared_is_said(calibrated: Arm, tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text("changed")
    (warning,) = already_used(calibrated, np.zeros((2, 3))).warnings
    assert "points.csv" in warning
    assert "or changed" in warning
    (warning,) = already_used(RIGHT, np.zeros((2, 3))).warnings
    assert "does not name its calibration data" in warning


def test_a_report_on_used_points_does_not_call_them_unused(tmp_path: Path) -> None:
    made = verification({"normal": 20.0}, {"normal": 1.0}, used_count=6, pose_count=6)
    assert made.verdict[0].startswith("NOT VERIFIED: 6 of the 6 poses were used")
    assert made.verifies_nothing
    assert not replace(made, pose_count=18).verifies_nothing
    write_verification_report(tmp_path / "report.html", made)
    assert "did not use" not in (tmp_path / "report.html").read_text("utf-8")
