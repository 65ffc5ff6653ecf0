"""A session: order of motions, still-stand, what is recorded, what happens when something goes wrong."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.calibration.chains import REFERENCE, REFERENCE_DH, TILTS, angles_for
from calib.errors import SessionError, UnusablePointsError
from calib.points.points import read_points
from calib.session import take as sequence
from calib.session.conduct import Boards
from calib.session.conversation import GO
from calib.session.take import SessionSettings, StandstillWindow, wait_for_rest
from control.model.table import cavities
from tests.calib.session.session_arm import RIGHT, SEED, TABLE, Bench, NumericGeometry, ScriptedArm, bench


def run(session: Bench) -> Bench:
    """Everything that is left, each question answered with GO."""
    session.run([GO] * 40)
    return session


def motions(session: Bench) -> list[str]:
    """What the arm and the hand were told, without the questions."""
    return [entry for entry in session.arm.log if entry.split()[0] not in ("board", "next", "done")]


def tip_of(setup: str, point: str) -> np.ndarray:
    return np.array(cavities(TABLE, setup)[point])


def test_a_point_is_approached_from_above_seated_held_recorded_and_left_upwards(tmp_path: Path) -> None:
    session = run(bench(tmp_path, ["1"]))
    assert motions(session) == ["move", "grip", "release", "seat", "hold", "hold", "let go", "move", "move"]
    points, _ = read_points(tmp_path / "s" / "points.csv", 3)
    np.testing.assert_allclose(points.tip_m, [tip_of("normal", "1")], atol=1e-7)
    assert points.direction[0].tolist() == [1.0, -1.0, 1.0]
    assert points.current_A[0].tolist() == [0.3, 1.5, 0.5]
    assert points.extra["q1_sd_rad"] == ("0.000010000",)
    assert [points.extra[f"temperature{j}_C"] for j in (1, 2, 3)] == [("31.0",), ("40.5",), ("29.0",)]


def test_above_means_along_the_boards_normal(tmp_path: Path) -> None:
    session = bench(tmp_path, ["1"], ["roll"])
    session.settings = SessionSettings(approach_m=0.05)
    run(session)
    tilt = TILTS["roll"][0]
    normal, tip = np.array((0.0, -np.sin(tilt), np.cos(tilt))), tip_of("roll", "1")
    heights = [np.dot(np.subtract(at, tip), normal) for at in session.arm.tips]
    aside = [np.subtract(at, tip) - h * normal for at, h in zip(session.arm.tips, heights, strict=True)]
    np.testing.assert_allclose(heights, [0.05, 0.01, 0.05], atol=1e-6)  # above; out of the cavity, up
    np.testing.assert_allclose(aside, np.zeros((3, 3)), atol=1e-6)


def test_an_arm_that_stands_low_over_the_board_is_lifted_straight_off_first(tmp_path: Path) -> None:
    """As after a kill while the tip sat: the tip must not be dragged through its cavity."""
    session, tip = bench(tmp_path, ["2"], ["roll"]), tip_of("roll", "1")
    session.arm.seat(tuple(tip.tolist()))
    session.arm.t_s = 10.0  # it rests long since
    run(session)
    tilt = TILTS["roll"][0]
    up = np.subtract(session.arm.tips[:2], tip)
    np.testing.assert_allclose(up, np.outer([0.01, 0.06], (0.0, -np.sin(tilt), np.cos(tilt))), atol=1e-6)


def test_an_arm_that_stands_high_is_not_lifted(tmp_path: Path) -> None:
    session = run(bench(tmp_path, ["1"]))
    np.testing.assert_allclose(session.arm.tips[0], tip_of("normal", "1") + np.array((0.0, 0.0, 0.06)), atol=1e-6)


def test_encoders_are_averaged_only_once_the_arm_rests(tmp_path: Path) -> None:
    run(bench(tmp_path, ["1"], arm=ScriptedArm(settle_s=0.5)))
    points, _ = read_points(tmp_path / "s" / "points.csv", 3)
    exact = angles_for(REFERENCE, REFERENCE_DH, np.array([tip_of("normal", "1")]), SEED)
    np.testing.assert_allclose(points.q_rad, exact, atol=2e-9)


def test_an_arm_that_never_rests_is_an_error_and_is_left_held(tmp_path: Path) -> None:
    session = bench(tmp_path, ["1"], arm=ScriptedArm(settle_s=1e9))
    with pytest.raises(SessionError, match="does not come to rest"):
        run(session)
    assert session.arm.log[-2:] == ["hold", "let go"]


def test_a_session_that_is_stopped_lets_go_holds_and_resumes(tmp_path: Path) -> None:
    """Stopped by an interrupt while the third tip sits; the next start goes on there."""
    names = ["1", "2", "3", "4"]
    session = bench(tmp_path, names)
    seated = session.arm.seat

    def interrupted(point_m) -> None:
        seated(point_m)
        if session.arm.log.count("seat") == 3:
            raise KeyboardInterrupt

    session.arm.seat = interrupted
    with pytest.raises(KeyboardInterrupt):
        run(session)
    assert session.arm.log[-2:] == ["hold", "let go"]
    assert [kept.record.point for kept in session.kept] == ["1", "2"]
    assert [kept.record.point for kept in run(bench(tmp_path, names)).kept] == ["3", "4"]
    assert read_points(tmp_path / "s" / "points.csv", 3)[0].point == tuple(names)


def test_a_point_out_of_reach_is_reported_and_the_others_are_taken(tmp_path: Path) -> None:
    session = bench(tmp_path, ["1", "2", "3"])
    far = Boards(RIGHT, session.plan).tip_m(session.plan.targets[1])
    session.geometry = NumericGeometry(far=far)
    run(session)
    assert "normal 2 is skipped: target is out of reach by 0.012 m" in session.told
    assert read_points(tmp_path / "s" / "points.csv", 3)[0].point == ("1", "3")


def test_each_setup_is_set_up_once_with_the_arm_lifted(tmp_path: Path) -> None:
    log = run(bench(tmp_path, ["1", "2"], ["normal", "roll"])).arm.log
    asked = [k for k, entry in enumerate(log) if entry.startswith("board")]
    assert [log[k] for k in asked] == ["board normal 1", "board roll 1"]
    assert log[asked[1] - 1] == "move"


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
