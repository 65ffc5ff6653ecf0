"""Recorded files to the fourteen criteria: what is there is computed, what is missing is said, what is wrong is refused."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.errors import UnusablePointsError
from calib.iso9283.evaluation import evaluate
from calib.iso9283.pose_criteria import Iso9283Error
from calib.iso9283.programme import TestCube, solver_of
from calib.iso9283.recorded import BESIDE, SET, RecordedRun, pose_groups, read_rectangle, read_runs
from calib.iso9283.result import CRITERIA, Criterion, Evaluation, summary_text, write_document, write_page
from calib.points.points import Points, joined, make_points, read_points
from calib.points.writer import PointsWriter, Record
from calib.results import made_today
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm
from control.model.description import load_arm

CUBE = TestCube((0.40, 0.0, 0.30), 0.2)
OFFSET = np.array((0.003, -0.004, 0.0))  # 5 mm
NOISE_m = 1e-4


@pytest.fixture(scope="module")
def arm() -> Arm:
    return load_arm("right")


def visits(
    arm: Arm, setups: Sequence[str] = ("pose",), names: Sequence[str] = ("P1", "P2", "P4"), n: int = 10, **keys: object
) -> Points:
    """Visits of poses, off by OFFSET with noise."""
    rng, solver, poses = np.random.default_rng(1), solver_of(arm, CUBE), CUBE.poses()
    keys_of = [(s, p, k + 1) for s in setups for k in range(n) for p in names]
    q = np.array([solver(np.array(poses[p])) for _, p, _ in keys_of])
    wanted = np.array([poses[p] for _, p, _ in keys_of])
    tip = wanted + OFFSET + rng.normal(scale=NOISE_m, size=wanted.shape)
    setup, point, repeat = zip(*keys_of, strict=True)
    return make_points(setup, point, repeat, q, tip, t_s=np.arange(float(len(q))), **keys)  # type: ignore[arg-type]


def found(arm: Arm, points: Points, runs: Sequence[RecordedRun] = (), **keys: object) -> dict[int, Criterion]:
    groups, _ = pose_groups(points, arm, Path("points.csv"))
    return {c.number: c for c in evaluate(groups, runs, **keys).criteria}  # type: ignore[arg-type]


def line_run(arm: Arm, number: int, programme: str = "line", y_m: float = 0.0, noise_m: float = 0.0) -> RecordedRun:
    """0.3 m along x in 3 s between two rests, attained at y_m."""
    t = np.arange(0.0, 4.0, 0.01)
    x = 0.1 * np.clip(t - 0.2, 0.0, 3.0)
    wanted = np.column_stack((0.25 + x, 0 * x, 0.3 + 0 * x))
    noise = np.random.default_rng(number).normal(scale=noise_m or 1e-12, size=wanted.shape)
    seen = wanted + np.array((0.0, y_m, 0.0)) + noise
    return RecordedRun(number, programme, number, 0.1, t, wanted, wanted, t, seen)


def test_accuracy_repeatability_and_distance_are_those_of_the_data(arm: Arm) -> None:
    of = found(arm, visits(arm, n=30))
    accuracy = {f.where: f.value for f in of[1].figures if f.symbol == "AP_p"}
    assert set(accuracy) == {"P1", "P2", "P4"}
    assert list(accuracy.values()) == pytest.approx([5e-3] * 3, abs=4 * NOISE_m / np.sqrt(30))
    scatter = [f.value for f in of[1].figures if f.symbol == "RP_l"]
    assert scatter == pytest.approx([3.6 * NOISE_m] * 3, rel=0.3)  # Maxwell; 30 visits leave some 10 %
    distance = {f.symbol: f.value for f in of[3].figures}
    assert abs(distance["AD"]) < 4 * NOISE_m * np.sqrt(2 / 30)  # both ends are off by the same
    assert distance["RD"] == pytest.approx(3 * np.sqrt(2) * NOISE_m, rel=0.5)


def test_the_worst_pose_stands_for_its_criterion(arm: Arm) -> None:
    (headline,) = (f for f in found(arm, visits(arm))[1].headlines if f.symbol == "AP_p")
    assert headline.value == max(f.value for f in found(arm, visits(arm))[1].figures if f.symbol == "AP_p")


def test_fourteen_criteria_stand_in_order_and_each_without_a_figure_says_what_it_needs(arm: Arm) -> None:
    of = found(arm, visits(arm, n=1))
    assert list(of) == [number for number, _, _ in CRITERIA] == list(range(1, 15))
    assert all(c.figures or c.needs for c in of.values())
    assert any("second visit" in need for need in of[1].needs)
    assert any("orientation of the tip" in need for need in of[1].needs)
    assert "by four other arms" in of[7].needs[0]
    assert "three joints only set" in of[9].needs[0]
    assert not {f.symbol for f in of[1].figures} & {"RP_l"}


def test_visits_without_a_measured_tip_are_said_and_not_counted(arm: Arm) -> None:
    whole = visits(arm)
    tip = np.array(whole.tip_m)
    tip[0] = np.nan
    of = found(arm, make_points(whole.setup, whole.point, whole.repeat, whole.q_rad, tip))
    assert any("in 1 of 30 visits: of P1" in need for need in of[1].needs)
    assert {f.count for f in of[1].figures if f.where == "P1"} == {9}
    nothing = found(arm, make_points(whole.setup, whole.point, whole.repeat, whole.q_rad, np.full_like(tip, np.nan)))
    assert not nothing[1].figures
    assert any("by a camera" in need for need in nothing[1].needs)


def test_a_table_full_of_points_is_one_sentence_each_not_ninety(arm: Arm) -> None:
    names = [f"{k}" for k in range(90)]
    q = np.tile((0.0, -0.2, -0.3), (90, 1))
    tip = ForwardKinematics(arm).tips(q)
    tip[::2] = np.nan
    needs = found(arm, make_points(["roll"] * 90, names, [1] * 90, q, tip))[1].needs
    assert len(needs) == 3
    assert any("45 of 90 visits: of 0 (roll), 10 (roll)" in need and "and 40 more" in need for need in needs)


def test_commanded_positions_are_the_columns_else_the_angles_through_the_arm(arm: Arm) -> None:
    plain = visits(arm)
    n = len(plain)
    columns = {name: tuple(["0.1"] * n) for name in ("x_set_m", "y_set_m", "z_set_m")}
    for extra, says, wanted in (
        ({}, "encoder angles", CUBE.centre_m),
        (columns, "columns x_set_m", (0.1, 0.1, 0.1)),
        ({f"q{j}_set_rad": tuple(["0.1"] * n) for j in (1, 2, 3)}, "set-points", ForwardKinematics(arm).tip(0.1, 0.1, 0.1)),
    ):
        points = make_points(plain.setup, plain.point, plain.repeat, plain.q_rad, plain.tip_m, extra=extra)
        groups, notes = pose_groups(points, arm, Path("points.csv"))
        assert says in notes[0]
        assert groups[0].commanded_m == pytest.approx(wanted)


def test_commanded_positions_that_cannot_be_had_are_said(arm: Arm) -> None:
    plain = visits(arm)
    n = len(plain)

    def refused(q: np.ndarray, extra: dict[str, tuple[str, ...]], says: str) -> None:
        points = make_points(plain.setup, plain.point, plain.repeat, q, plain.tip_m, extra=extra)
        with pytest.raises(Iso9283Error, match=says):
            pose_groups(points, arm, Path("points.csv"))

    refused(np.zeros((n, 2)), {}, "columns x_set_m.*the file 2")
    refused(plain.q_rad, {"x_set_m": ("0.1",) * n}, "column y_set_m is missing beside x_set_m")
    axes = {"y_set_m": ("0.1",) * n, "z_set_m": ("0.1",) * n}
    refused(plain.q_rad, {"x_set_m": ("oops",) * n, **axes}, 'points.csv, line 2, column x_set_m: got "oops"')


def test_a_wrong_cell_is_named_by_its_line_whatever_lines_are_empty(arm: Arm, tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    rows = ["setup,point,repeat,q1_rad,q2_rad,q3_rad,x_set_m,y_set_m,z_set_m"]
    rows += ["", "pose,P1,1,0,-0.2,-0.3,0.4,0,0.3", "", "pose,P1,2,0,-0.2,-0.3,0.4,oops,0.3"]
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    points, warnings = read_points(path, also=BESIDE)
    assert not warnings
    for some in (points, points.chosen([1]), joined([points, points]).chosen([3])):
        with pytest.raises(Iso9283Error, match=r'points\.csv, line 5, column y_set_m: got "oops"'):
            pose_groups(some, arm, path)


def test_directions_drift_and_loads_are_known_by_their_setups(arm: Arm) -> None:
    rows = visits(arm, ("from_x", "from_y", "from_z", "drift_1", "drift_2", "load"), ("P1",))
    tip = np.array(rows.tip_m)
    setup = np.array(rows.setup)
    tip[setup == "from_y"] += (0.0, 0.0, 0.002)
    tip[setup == "drift_2"] += 0.6 * OFFSET
    mass = np.where(setup == "load", np.arange(len(setup)) % 5 * 1.0, 0.0)
    tip[setup == "load"] += np.outer(mass[setup == "load"], (0, 0, -9.81e-4))  # 0.1 mm/N
    of = found(arm, make_points(rows.setup, rows.point, rows.repeat, rows.q_rad, tip, t_s=rows.t_s, payload_kg=mass))
    assert of[2].headlines[0].value == pytest.approx(2e-3, abs=3e-4)
    assert {f.symbol: f.value for f in of[6].figures}["dAP_p"] == pytest.approx(3e-3, abs=2e-4)
    assert of[13].headlines[0].symbol == "per N along z"
    assert of[13].headlines[0].value == pytest.approx(1e-4, rel=0.1)
    assert "x and y" in of[13].needs[0]
    assert not of[1].figures  # none of these is a plain visit
    free = found(arm, visits(arm, ("free",), ("P1",)))
    assert free[1].figures
    assert not free[2].figures


def test_exchangeability_compares_arms_at_the_same_commanded_pose(arm: Arm) -> None:
    mine = visits(arm)
    other = make_points(mine.setup, mine.point, mine.repeat, mine.q_rad, mine.tip_m + np.array((0, 0, 0.01)))
    groups, _ = pose_groups(other, arm, Path("other.csv"))
    of = found(arm, mine, others={"other.csv": groups})
    assert of[7].headlines[0].value == pytest.approx(0.01)
    assert "got 1" in of[7].needs[0]
    elsewhere = [replace(g, commanded_m=g.commanded_m + 0.001) for g in groups]
    with pytest.raises(Iso9283Error, match=r"other\.csv: its commanded P1 is"):
        found(arm, mine, others={"other.csv": elsewhere})


def test_path_and_speed_of_recorded_runs(arm: Arm) -> None:
    runs = [line_run(arm, k, y_m=0.002, noise_m=1e-5) for k in range(1, 6)]
    of = found(arm, visits(arm), runs)
    path = {f.symbol: f.value for f in of[8].figures}
    assert path["AT_p"] == pytest.approx(2e-3, abs=3e-5)
    assert 2e-5 < path["RT_p"] < 1e-4  # largest of a hundred points' l + 3 S at 0.01 mm noise
    speed = {f.symbol: f.value for f in of[11].figures}
    assert abs(speed["AV"]) < 0.05
    assert speed["FV"] < 2e-3
    assert not of[4].figures  # a line is no approach


def test_runs_that_no_column_names_are_grouped_by_their_set_points(arm: Arm) -> None:
    runs = [line_run(arm, k, "", noise_m=1e-5) for k in (1, 2)]
    reverse = replace(runs[0], number=3, set_m=runs[0].set_m[::-1], seen_m=runs[0].seen_m[::-1])
    still = replace(runs[0], number=4, set_m=0.0 * runs[0].set_m)
    wavy = [replace(r, number=5, set_m=r.set_m + 0.01 * np.sin(30.0 * r.set_m[:, :1])) for r in runs]
    of = found(arm, visits(arm), [*runs, reverse, still, *wavy])
    # What was run once or does not move is no test; a path that is not straight has no AV.
    assert {(f.where, f.count) for f in of[8].figures} == {("path of run 1", 2), ("path of run 5", 2)}
    assert all(f.where.startswith("path of run 1") for f in of[11].figures)
    assert of[11].figures


def weave_run() -> RecordedRun:
    """Weaves along x for 6 s between two rests, at 95 % of its stroke; while it rests, somebody shakes the arm."""
    t = np.arange(0.0, 10.0, 0.01)
    moving = (t >= 2.0) & (t < 8.0)
    since = np.clip(t - 2.0, 0.0, 6.0)
    weave_m = 0.01 * np.sin(2 * np.pi * since)
    wanted, seen = (
        np.column_stack((0.25 + 0.05 * since, y_m, 0.3 + 0 * t))
        for y_m in (weave_m, np.where(moving, 0.95 * weave_m, 0.02 * np.sin(6 * np.pi * t)))
    )
    return RecordedRun(1, "weave", 1, 0.05, t, wanted, wanted, t, seen)


def test_weaving_is_that_of_the_motion_whatever_the_camera_sees_before_and_after(arm: Arm) -> None:
    weaving = found(arm, visits(arm), [weave_run()])[14]
    assert {f.symbol: f.value for f in weaving.figures} == pytest.approx({"WS": 5.0, "WF": 0.0}, abs=0.1)


def test_settling_is_judged_in_a_band_that_is_no_finer_than_the_measurement(arm: Arm) -> None:
    points = visits(arm)
    coarse = [line_run(arm, k, "approach", noise_m=5e-4) for k in (1, 2, 3)]
    figures = {f.symbol: f for f in found(arm, points, coarse)[4].figures}
    assert "scatter" in figures["t"].remark
    assert "repeatability RP_l of P1" in figures["t (encoders)"].remark
    wide = found(arm, points, coarse, band_m=0.01)
    assert all("10.000 mm (the given limit band)" in f.remark for f in wide[4].figures)
    assert [f.value for f in wide[5].figures] == [0.0, 0.0]


def test_without_a_camera_settling_is_had_by_the_encoders_and_says_so(arm: Arm) -> None:
    blind = [replace(line_run(arm, 1, "approach"), seen_s=np.zeros(0), seen_m=np.zeros((0, 3)))]
    of = found(arm, visits(arm), [*blind, replace(blind[0], programme="line")])
    assert [f.symbol for f in of[4].figures] == ["t (encoders)"]
    assert any("by a camera" in need for need in of[4].needs)
    assert any("by a camera" in need for need in of[8].needs)
    assert any("by a camera" in need for need in of[11].needs)


LOG = "run,t_s,q1_rad,q2_rad,q3_rad,q1_set_rad,q2_set_rad,q3_set_rad"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("run,t_s,q1_rad\n", "line 1: joint angles of 1 joints, expected 3"),
        (LOG + "\n", "a header and no samples: expected one line per sample"),
        (LOG + "\n1,0,0,0,0,0,0\n", "line 2: 7 values, line 1 names 8"),
        (LOG + "\n1,0,a,0,0,0,0,0\n", 'line 2, column q1_rad: got "a", expected a finite number'),
        (LOG + "\n1,0,,0,0,0,0,0\n", "line 2, column q1_rad: got an empty cell, expected a finite number"),
        (LOG + "\n1,0,0,0,0,,0,0\n", "two rows or more with set-points, got none"),
    ],
)
def test_a_log_that_is_none_is_refused_with_line_and_column(arm: Arm, tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(Iso9283Error, match=says):
        read_runs(tmp_path / "log.csv", arm)


def test_a_log_in_degrees_is_doubted_unless_it_is_taken_at_its_word(arm: Arm, tmp_path: Path) -> None:
    rows = "".join(f"1,{0.1 * k},{10 * k},{-5 * k},{7 * k},{10 * k},{-5 * k},{7 * k}\n" for k in range(1, 60))
    (tmp_path / "log.csv").write_text(f"{LOG}\n{rows}")
    with pytest.raises(UnusablePointsError, match="degrees"):
        read_runs(tmp_path / "log.csv", arm)


def test_tips_are_those_of_the_joints_where_the_recording_tells_them_from_the_encoders(arm: Arm, tmp_path: Path) -> None:
    joints = ",".join(form.format(j) for form in ("joint{}_rad", "joint{}_set_rad") for j in (1, 2, 3))
    encoders, where, wanted = "0,-0.6,0.2", "0.1,-0.6,0.2", "0.1,-0.5,0.2"
    rows = "".join(f"1,{t},{encoders},{encoders},{where},{wanted}\n" for t in (0.0, 0.1))
    (tmp_path / "log.csv").write_text(f"{LOG},{joints}\n{rows}")
    (run,) = read_runs(tmp_path / "log.csv", arm)
    tips = ForwardKinematics(arm).tips([[0.1, -0.6, 0.2], [0.1, -0.5, 0.2]])
    np.testing.assert_allclose(run.encoder_m[0], tips[0], atol=1e-12)
    np.testing.assert_allclose(run.set_m[1], tips[1], atol=1e-12)


def test_a_programme_file_of_something_else_is_refused(tmp_path: Path) -> None:
    for text in ("{}", "[1]", "not json", '{"format": "iso9283-programme/1", "rectangle_m": [[1, 2]]}'):
        (tmp_path / "programme.json").write_text(text)
        with pytest.raises(Iso9283Error, match=r"programme.json(, (format|rectangle_m): expected|: not JSON)"):
            read_rectangle(tmp_path / "programme.json")


def test_json_and_page_hold_every_criterion_and_no_outside_resource(arm: Arm, tmp_path: Path) -> None:
    groups, notes = pose_groups(visits(arm), arm, Path("points.csv"))
    runs = [line_run(arm, k, noise_m=1e-5) for k in (1, 2)] + [line_run(arm, 3, "approach", noise_m=1e-5)]
    result: Evaluation = evaluate(groups, runs, notes=notes)
    write_document(tmp_path / "page.json", result, "right", made_today())
    read = json.loads((tmp_path / "page.json").read_text("utf-8"))
    assert read["format"] == "iso9283/1"
    assert [c["number"] for c in read["criteria"]] == list(range(1, 15))
    assert read["criteria"][0]["values"]["AP_p"]["unit"] == "m"
    write_page(tmp_path / "page.html", result, "<right>", made_today())
    html = (tmp_path / "page.html").read_text("utf-8")
    assert html.count("<svg") == 4
    assert "&lt;right&gt;" in html
    assert "src=" not in html
    assert "Static compliance" in summary_text(result.criteria)


def test_columns_of_a_recording_are_read_back_as_points(arm: Arm, tmp_path: Path) -> None:
    path, tip, wanted = tmp_path / "points.csv", (0.4, 0.1, 0.2), (0.41, 0.1, 0.2)
    more = {name: f"{value:.9f}" for name, value in zip(SET, wanted, strict=True)}
    with PointsWriter(path, 3, more=SET) as writer:
        q, sides, amperes = (0.1, -0.2, 0.3), (1, -1, 0), (0.1, 0.2, 0.3)
        writer.append(Record("pose", "P1", 1, q, (1e-5,) * 3, sides, amperes, 0.5, 0.0, tip, more=more))
    points, warnings = read_points(path)
    assert not warnings
    groups, _ = pose_groups(points, arm, path)
    assert groups[0].commanded_m == pytest.approx(wanted)
    assert groups[0].attained_m[0] == pytest.approx(tip)
