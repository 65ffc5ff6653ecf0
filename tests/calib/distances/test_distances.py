"""Lengths as observations: what they determine, how exactly, and which files are refused."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.calibration.distances import (
    DIRECTION,
    RIGHT,
    ANCHORS_m,
    GAUGE_ZERO_m,
    SD_m,
    WIRE_ZERO_m,
    calibrated,
    over_workspace_m,
    recorded,
)
from calib import distance_calibration as module
from calib.arm_problem.assembly import Choice
from calib.distance_calibration import DistancePlan, compare_lengths, distances_text
from calib.distances import WireKnowledge, readings_of
from calib.errors import CalibrationError, PointsFileError, UnusablePointsError
from calib.points.points import Points, read_points
from calib.points.writer import write_points
from console.main import main
from control.model.description import load_arm, save_arm

FILE = Path("lengths.csv")


def with_column(points: Points, name: str, row: int, text: str) -> Points:
    column = list(points.extra[name])
    column[row] = text
    return dataclasses.replace(points, extra={**points.extra, name: tuple(column)})


def test_derivatives_by_the_arm_and_by_every_kind_of_device_are_exact() -> None:
    of = recorded(1, "AB", each=6, gauge=5, pairs=4, tips=5)
    plan = DistancePlan(Choice(freed=("tool",)), WireKnowledge(True, {"B": ANCHORS_m["B"]}))
    _, problem = module._problem(RIGHT, of.points, readings_of(RIGHT, of.points, FILE), plan)
    x = np.random.default_rng(2).uniform(-0.01, 0.01, len(problem.parameters))
    residuals, jacobian = problem.residuals_and_jacobian(x)
    np.testing.assert_allclose(problem.residuals(x), residuals)
    for k in range(len(x)):
        step = np.zeros(len(x))
        step[k] = 1e-6
        slope = (problem.residuals(x + step) - problem.residuals(x - step)) / 2e-6
        np.testing.assert_allclose(jacobian[:, :, k], slope, rtol=1e-6, atol=1e-8)
    expanded = problem.expanded(x)
    gradient, gram = expanded.sums(residuals, None)
    rows = jacobian.reshape(-1, len(x))
    np.testing.assert_allclose(gradient, rows.T @ residuals.ravel(), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(gram, rows.T @ rows, rtol=1e-9, atol=1e-12)
    assert problem.residuals(x, slice(None, None, 2)).shape == (-(-len(problem) // 2), 3)


def test_one_wire_makes_the_arm_right_but_for_where_it_stands() -> None:
    of = recorded(0, "A")
    calibration = calibrated(of)
    assert over_workspace_m(of.true, RIGHT.dh).mean() > 5e-3
    assert over_workspace_m(of.true, calibration.found.dh).mean() < 0.1e-3
    assert calibration.found.rank - 3 == 8
    assert np.abs(calibration.before_m).mean() > 3e-3
    assert np.abs(calibration.held_m).mean() < 1.5 * SD_m
    assert calibration.found.noise_m == pytest.approx(SD_m, rel=0.35)
    text = distances_text(calibration)
    assert "d1 and theta1 cannot be told apart from the place of wire A" in text
    assert "wire:A: fixed point [m] in the base frame: [" in text


def test_wires_at_known_points_say_all_that_measured_tips_say() -> None:
    of = recorded(3, "AB", each=20)
    known = {name: ANCHORS_m[name] for name in "AB"}
    calibration = calibrated(of, WireKnowledge(known_m=known))
    assert calibration.found.rank == 10
    assert over_workspace_m(of.true, calibration.found.dh, is_placed=True).mean() < 0.2e-3
    assert all(len(device.parameters) == 0 for device in calibration.devices)
    with pytest.raises(UnusablePointsError, match='no wire "C" in the readings: expected one of A, B'):
        calibrated(of, WireKnowledge(known_m={"C": (0.0, 0.0, 0.0)}))


def test_gauge_zero_and_pairs_are_found_together_and_a_wrong_reading_does_little() -> None:
    of = recorded(4, "A", each=20, gauge=16, pairs=6, zero_m=WIRE_ZERO_m)
    wrong = with_column(of.points, "distance_m", 3, f"{float(of.points.extra['distance_m'][3]) + 0.05:.6f}")
    calibration = calibrated(dataclasses.replace(of, points=wrong), WireKnowledge(free_zero=True))
    assert over_workspace_m(of.true, calibration.found.dh).mean() < 0.15e-3
    wire, gauge = calibration.zero_m[0], calibration.places[1]
    assert wire == pytest.approx(WIRE_ZERO_m, abs=1.5e-3)
    assert np.degrees(np.arccos(gauge @ DIRECTION)) < 2.0  # the base's own turn is not known better
    assert calibration.zero_m[1] == pytest.approx(GAUGE_ZERO_m, abs=5e-3)
    assert np.argmax(np.abs(calibration.after_m)) == 3


def test_lengths_and_tips_are_one_identification() -> None:
    of = recorded(5, "A", each=30, tips=8)
    calibration = calibrated(of)
    assert calibration.tips == 8
    assert calibration.found.rank - 3 == 10  # the tips tie the wire to the base
    np.testing.assert_allclose(calibration.places[0], ANCHORS_m["A"], atol=1e-3)
    assert over_workspace_m(of.true, calibration.found.dh, is_placed=True).mean() < 0.2e-3


def broken(change: str) -> Points:
    points = recorded(0, "A", each=8, pairs=1).points
    match change:
        case "degrees":
            return dataclasses.replace(points, q_rad=np.degrees(points.q_rad))
        case "other arm":
            return dataclasses.replace(points, q_rad=points.q_rad[:, ::-1])
        case "few":
            return points.chosen(range(5))
        case "few of one":
            return with_column(recorded(0, "AB", each=8).points.chosen(range(11)), "distance_sd_m", 0, "")
        case "pair":
            return points.chosen(range(9))
        case "lengths of a pair":
            return with_column(points, "distance_m", 9, "0.1")
        case "none":
            return dataclasses.replace(points, extra={**points.extra, "distance_of": ("",) * len(points)})
        case "no column":
            return dataclasses.replace(points, extra={"distance_of": points.extra["distance_of"]})
    column, _, text = change.partition("=")
    return with_column(points, column, 1, text)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("distance_of=wirr:A", 'lengths.csv, line 3, column distance_of: got "wirr:A", expected wire:NAME'),
        ("distance_of=wire:", 'got "wire:"'),
        ("distance_m=", "column distance_m: got an empty cell, expected a length within"),
        ("distance_m=812", "expected a length within"),
        ("distance_sd_m=-1", "expected a number above 0"),
        ("degrees", "more than three turns: expected radians"),
        ("other arm", "expected joint angles in rad, lengths in m, of this arm"),
        ("few", "5 readings of lengths, 6 are needed"),
        ("few of one", '"wire:B": 3 readings, 4 are needed'),
        ("pair", '"between:0" has no second pose'),
        ("lengths of a pair", "expected the same distance in both lines of a pair"),
        ("none", "every cell is empty"),
        ("no column", "required column distance_m is missing"),
    ],
)
def test_a_file_that_cannot_be_used_is_one_message(change: str, said: str) -> None:
    with pytest.raises((PointsFileError, UnusablePointsError), match=said):
        calibrated(dataclasses.replace(recorded(0, "A", each=8), points=broken(change)))


def test_an_unknown_name_lists_those_there_are() -> None:
    with pytest.raises(CalibrationError, match="expected one of d1, theta1"):
        calibrated(recorded(0, "A", each=8), choice=Choice(fixed=("L9",)))


def test_lengths_verify_an_arm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    of = recorded(6, "B", each=12, gauge=8, pairs=6, zero_m=WIRE_ZERO_m)
    write_points(tmp_path / "new.csv", of.points)
    save_arm(RIGHT.with_dh(of.true.dh), tmp_path / "arm.toml")
    given = ["verify", "--arm", str(tmp_path / "arm.toml"), "--against", "right", "--json"]
    new = ["--points", str(tmp_path / "new.csv"), "--free-zero"]
    assert main([*given, *new, "--out", str(tmp_path / "v")]) == 0
    content = json.loads(capsys.readouterr().out)
    assert {name: one["after"]["count"] for name, one in content["by_setup"].items()} == {
        "wire:B": 12,
        "gauge:G": 8,
        "between": 6,
        "all": 26,
    }
    for one in content["by_setup"].values():
        assert one["after"]["mean_m"] < 3.0 * SD_m < 1e-3 < one["before"]["mean_m"]
    for more, text in (
        ([*new, "--wire-at", "C=0,0,1"], 'no wire "C" in the readings: expected one of B'),
        ([*new, "--wire-at", "B=0,0"], "expected NAME=X,Y,Z in m"),
        (["--free-zero"], "are for lengths: give them with --points"),
    ):
        assert main([*given, *more, "--out", str(tmp_path / "w")]) == 2
        assert text in capsys.readouterr().err


def test_a_reading_does_not_verify_the_place_of_its_own_device() -> None:
    of = recorded(3, "A", each=7)
    arm = dataclasses.replace(RIGHT.with_dh(of.true.dh))
    comparison = compare_lengths(RIGHT, arm, of.points, FILE, WireKnowledge())
    names, lengths = list(of.points.extra["distance_m"]), []
    for row in (0, 3):
        points = with_column(of.points, "distance_m", row, f"{float(names[row]) + 0.001:.9f}")
        moved = compare_lengths(RIGHT, arm, points, FILE, WireKnowledge())
        lengths.append(np.linalg.norm(moved.after_m[row] - comparison.after_m[row]))
    assert np.allclose(lengths, 1e-3, atol=1e-4)  # none of it went into the wire's place
    with pytest.raises(UnusablePointsError, match='"wire:A": 4 readings, 5 are needed'):
        compare_lengths(RIGHT, arm, of.points.chosen(range(4)), FILE, WireKnowledge())


def test_the_command_writes_a_calibrated_arm_and_calibrate_points_to_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    of = recorded(6, "A", each=30)
    write_points(tmp_path / "lengths.csv", of.points)
    assert read_points(tmp_path / "lengths.csv", 3)[1] == ()
    given = ["--points", str(tmp_path / "lengths.csv"), "--out", str(tmp_path / "out")]
    assert main(["calibrate", *given]) == 2
    assert "calibrate with `armwright calibrate-distances`" in capsys.readouterr().err
    assert main(["calibrate-distances", *given, "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["held_out"]["mean_after_m"] < 2 * SD_m
    assert len(content["devices"]["wire:A"]["point_m"]) == 3
    arm = load_arm(tmp_path / "out" / "arm.toml")
    assert over_workspace_m(of.true, arm.dh).mean() < 0.2e-3
    assert main(["calibrate-distances", *given]) == 2
    assert "never overwritten" in capsys.readouterr().err
    for wrong in ("A", "A=1,2", "A=1,2,x", "A=1,2,99"):
        assert main(["calibrate-distances", *given[:2], "--out", str(tmp_path / "two"), "--wire-at", wrong]) == 2
        assert "expected NAME=X,Y,Z in m" in capsys.readouterr().err
