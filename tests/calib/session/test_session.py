"""A session: order of motions, still-stand, what is recorded, what happens when something goes wrong."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.calibration.chains import REFERENCE, REFERENCE_DH, TILTS, angles_for
from calib.errors import SessionError, UnusablePointsError
from calib.points.reading import read_points
from calib.points.writer import PointsWriter
from calib.session import take as sequence
from calib.session.take import PointStage, SessionSettings, StandstillWindow, step_through, wait_for_rest
from tests.calib.session.session_arm import SEED, NumericGeometry, ScriptedArm, board


def run(path: Path, arm: ScriptedArm, points, geometry=None, **others):
    with PointsWriter(path, 3) as writer:
        return list(step_through(points, geometry or NumericGeometry(), arm, arm, writer, **others))


def test_a_point_is_approached_from_above_seated_held_recorded_and_left_upwards(tmp_path: Path) -> None:
    arm = ScriptedArm()
    events = run(tmp_path / "points.csv", arm, board("normal", 1))
    assert [event.stage for event in events] == [
        PointStage.SETUP,
        PointStage.ABOVE,
        PointStage.SEATED,
        PointStage.RECORDED,
    ]
    assert arm.log == ["move", "grip", "release", "seat", "hold", "hold", "let go", "move", "move"]
    points, _ = read_points(tmp_path / "points.csv", 3)
    np.testing.assert_allclose(points.tip_m, [[0.59, 0.0, 0.0]], atol=1e-7)
    assert points.direction[0].tolist() == [1.0, -1.0, 1.0]
    assert points.current_A[0].tolist() == [0.3, 1.5, 0.5]
    assert points.extra["q1_sd_rad"] == ("0.000010000",)
    assert [points.extra[f"temperature{j}_C"] for j in (1, 2, 3)] == [("31.0",), ("40.5",), ("29.0",)]


def test_above_means_along_the_boards_normal(tmp_path: Path) -> None:
    arm = ScriptedArm()
    target = board("roll", 1)[0]
    tilt = TILTS["roll"][0]
    np.testing.assert_allclose(target.normal, (0.0, -np.sin(tilt), np.cos(tilt)), atol=1e-12)
    run(tmp_path / "points.csv", arm, [target], settings=SessionSettings(approach_m=0.05))
    heights = [np.dot(np.subtract(tip, target.tip_m), target.normal) for tip in arm.tips]
    aside = [
        np.subtract(tip, target.tip_m) - h * np.array(target.normal)
        for tip, h in zip(arm.tips, heights, strict=True)
    ]
    np.testing.assert_allclose(heights, [0.05, 0.01, 0.05], atol=1e-6)  # above; out of the cavity, up
    np.testing.assert_allclose(aside, np.zeros((3, 3)), atol=1e-6)


def test_an_arm_that_stands_low_over_the_board_is_lifted_straight_off_first(tmp_path: Path) -> None:
    """As after a kill while the tip sat: the tip must not be dragged through its cavity."""
    arm, points = ScriptedArm(), board("roll", 2)
    arm.seat(points[0].tip_m)
    arm.t_s = 10.0  # it rests long since
    run(tmp_path / "points.csv", arm, points[1:])
    up = np.subtract(arm.tips[:2], points[0].tip_m)
    np.testing.assert_allclose(up, np.outer([0.01, 0.06], points[0].normal), atol=1e-6)


def test_an_arm_that_stands_high_is_not_lifted(tmp_path: Path) -> None:
    arm, points = ScriptedArm(), board("normal", 1)
    run(tmp_path / "points.csv", arm, points)
    np.testing.assert_allclose(arm.tips[0], np.add(points[0].tip_m, (0.0, 0.0, 0.06)), atol=1e-6)


def test_encoders_are_averaged_only_once_the_arm_rests(tmp_path: Path) -> None:
    arm = ScriptedArm(settle_s=0.5)
    run(tmp_path / "points.csv", arm, board("normal", 1))
    points, _ = read_points(tmp_path / "points.csv", 3)
    exact = angles_for(REFERENCE, REFERENCE_DH, np.array([[0.59, 0.0, 0.0]]), SEED)
    np.testing.assert_allclose(points.q_rad, exact, atol=2e-9)


def test_an_arm_that_never_rests_is_an_error_and_is_left_held(tmp_path: Path) -> None:
    arm = ScriptedArm(settle_s=1e9)
    with pytest.raises(SessionError, match="does not come to rest"):
        run(tmp_path / "points.csv", arm, board("normal", 1))
    assert arm.log[-2:] == ["hold", "let go"]


def test_a_session_that_is_stopped_lets_go_holds_and_resumes(tmp_path: Path) -> None:
    arm, points = ScriptedArm(), board("normal", 4)
    with PointsWriter(tmp_path / "points.csv", 3) as writer:
        steps = step_through(points, NumericGeometry(), arm, arm, writer)
        for event in steps:
            if event.stage is PointStage.SEATED and event.point == "3":
                break
        steps.close()
    assert arm.log[-2:] == ["hold", "let go"]
    events = run(tmp_path / "points.csv", ScriptedArm(), points)
    assert [e.point for e in events if e.stage is PointStage.KEPT] == ["1", "2"]
    assert [e.point for e in events if e.stage is PointStage.RECORDED] == ["3", "4"]
    assert [e.done_count for e in events][-1] == events[-1].total_count == 4


def test_a_point_out_of_reach_is_reported_and_the_others_are_taken(tmp_path: Path) -> None:
    points = board("normal", 3)
    events = run(tmp_path / "points.csv", ScriptedArm(), points, NumericGeometry(far=points[1].tip_m))
    missed = [event for event in events if event.stage is PointStage.UNREACHABLE]
    assert [(event.point, event.reason) for event in missed] == [("2", "target is out of reach by 0.012 m")]
    assert read_points(tmp_path / "points.csv", 3)[0].point == ("1", "3")


def test_each_setup_is_set_up_once_with_the_arm_lifted(tmp_path: Path) -> None:
    arm = ScriptedArm()
    run(
        tmp_path / "p.csv",
        arm,
        [*board("normal", 2), *board("roll", 2)],
        set_up=arm.log.append,
    )
    assert [entry for entry in arm.log if entry in TILTS] == ["normal", "roll"]
    assert arm.log[arm.log.index("roll") - 1] == "move"


def test_still_stand_needs_its_whole_time_below_the_limit() -> None:
    still = StandstillWindow(limit_rad=1e-4, duration_s=0.1)
    assert not any(still.update(0.02 * k, (0.0, 0.0)) for k in range(5))
    assert still.update(0.10, (0.0, 0.9e-4))
    assert not still.update(0.12, (0.0, 1.1e-4))
    assert not still.update(0.20, (0.0, 0.9e-4 + 1.1e-4))
    assert still.update(0.34, (0.0, 2.0e-4))


def test_an_encoder_between_two_counts_is_at_rest() -> None:
    count_rad = (3e-5, 1.5e-3)
    still, drifting = (StandstillWindow(limit_rad=1e-4, duration_s=0.1) for _ in range(2))
    for k in range(20):
        still.update(0.02 * k, (0.0, 1.5e-3 * (k % 2)), count_rad)
        drifting.update(0.02 * k, (0.0, 4e-4 * k), count_rad)
    assert still.update(0.4, (0.0, 0.0), count_rad)
    assert not drifting.update(0.4, (0.0, 8e-3), count_rad)


def test_waiting_for_rest_gives_up_after_its_patience() -> None:
    arm = ScriptedArm(settle_s=1e9)
    arm.moved_s = 0.0
    with pytest.raises(SessionError, match="after 2 s"):
        wait_for_rest(arm, 1e-4, 0.1, 2.0, 0.02)
    assert arm.t_s < 2.1


def test_a_tip_that_was_not_measured_is_the_cavity_it_sat_in(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("setup,point,repeat,q1_rad,x_m,y_m,z_m\na,1,1,0.1,,,\na,2,1,0.1,9,9,9\n")
    points, _ = read_points(tmp_path / "p.csv")
    filled = sequence.with_reference_tips(points, lambda setup: {"1": (0.5, 0.1, 0.0)})
    np.testing.assert_allclose(filled.tip_m, [[0.5, 0.1, 0.0], [9, 9, 9]])
    with pytest.raises(UnusablePointsError, match="point 1 of setup a"):
        sequence.with_reference_tips(points, lambda setup: {"7": (0.5, 0.1, 0.0)})
