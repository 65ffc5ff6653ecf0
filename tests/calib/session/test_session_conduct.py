"""A session with an operator: nothing moves unasked, every way out is held, redo and skip and bad do what they say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.calibration.chains import REFERENCE, REFERENCE_DH
from calib.boards import read_boards
from calib.points.points import read_points
from calib.session.conduct import Boards
from calib.session.conversation import GO, Do, SessionCommand, SmallMove
from calib.session.plan import Mark, board_targets, free_targets
from calib.session.residual_watch import ResidualWatch
from control.model.table import cavities
from tests.calib.session.session_arm import ALL, BAD, GEOMETRY, QUIT, REDO, RIGHT, SKIP, TABLE, CavityHand, NumericGeometry, bench


def test_by_hand_nothing_moves_and_no_drive_lets_go_unasked(tmp_path: Path) -> None:
    session = bench(tmp_path, has_hand=False)
    session.run([GO] * 20)
    assert session.arm.log == [
        "board normal 1",
        "next normal 1",
        "move",
        "take normal 1",
        "release",
        "seated normal 1",
        "hold",
        "hold",
        "next normal 7",
        "move",
        "move",
        "move",
        "take normal 7",
        "release",
        "seated normal 7",
        "hold",
        "hold",
        "done",
        "move",
        "move",
    ]
    points, _ = read_points(tmp_path / "s" / "points.csv", 3)
    assert points.point == ("1", "7")


def test_quitting_at_every_question_leaves_the_arm_held_and_the_session_goes_on_there(tmp_path: Path) -> None:
    """Stopped at each of its questions, resumed, and whole in the end."""
    for stop in range(8):
        session = bench(tmp_path / str(stop), has_hand=False)
        session.run([GO] * stop)
        log = session.arm.log
        if "release" in log:
            assert "hold" in log[len(log) - 1 - log[::-1].index("release") :]
        assert log[-1] not in ("move", "creep"), "quit moves nothing"
        session.run([GO] * 20)
        assert set(session.marks.values()) == {Mark.DONE}
        assert len(read_points(tmp_path / str(stop) / "s" / "points.csv", 3)[0]) == 2


def test_a_session_resumed_with_the_tip_at_a_point_lifts_straight_off_before_it_goes_anywhere(tmp_path: Path) -> None:
    session = bench(tmp_path, has_hand=False, setups=("roll",))
    session.run([GO, GO, GO, QUIT])  # at "seated"
    session.arm.seat(cavities(TABLE, "roll")["1"])
    session.arm.t_s += 10.0
    session.arm.tips.clear()
    session.run([GO] * 3)
    normal = np.array(Boards(RIGHT, session.plan).normal("roll"))
    up = np.subtract(session.arm.tips[:2], cavities(TABLE, "roll")["1"])
    np.testing.assert_allclose(up, np.outer([0.01, 0.06], normal), atol=1e-6)
    assert any("first retracts it" in text for text in session.told)


def test_skip_redo_bad_and_note_do_what_they_say(tmp_path: Path) -> None:
    session = bench(tmp_path, points=("1", "7", "13", "19"))
    session.run(
        [
            GO,
            GO,  # board, 1
            REDO,  # of 1, asked about 7
            GO,
            SessionCommand(Do.NOTE, text="windy"),
            GO,  # 1 again, 7
            BAD,  # 7
            SKIP,  # 13
            SessionCommand(Do.BAD, point="13"),  # refused: it is not recorded
            SessionCommand(Do.SKIP, "normal", "19"),
            SessionCommand(Do.REDO, point="13"),
            GO,  # 13
            GO,  # nothing is left
        ]
    )
    assert session.marks == {
        ("normal", "1"): Mark.DONE,
        ("normal", "7"): Mark.BAD,
        ("normal", "13"): Mark.DONE,
        ("normal", "19"): Mark.SKIPPED,
    }
    points, _ = read_points(tmp_path / "s" / "points.csv", 3)
    assert sorted(zip(points.point, points.extra["take"], strict=True)) == [("1", "2"), ("13", "1")]
    assert "normal 13 is skipped, so not bad: `redo` it first" in session.told
    assert '"windy"' in (tmp_path / "s" / "journal.jsonl").read_text()


@pytest.mark.parametrize("command", [REDO, BAD])
def test_a_record_that_is_withdrawn_is_no_longer_believed(tmp_path: Path, monkeypatch, command: SessionCommand) -> None:
    forgotten: list = []
    monkeypatch.setattr(ResidualWatch, "forget", lambda watch, key: forgotten.append(key))
    session = bench(tmp_path)
    session.run([GO, GO, command])
    assert forgotten == [("normal", "1", 1)]


def test_a_redo_after_everything_is_done_opens_the_session_again(tmp_path: Path) -> None:
    session = bench(tmp_path, points=("1",))
    session.run([GO, GO, REDO, GO, GO])
    session.run([SessionCommand(Do.REDO, point="1")])  # resumed: the setup is that in which the board stood last
    assert session.marks == {("normal", "1"): Mark.LEFT}
    session.run([GO] * 3)
    assert session.arm.log.count("done") == 4
    assert read_points(tmp_path / "s" / "points.csv", 3)[0].extra["take"] == ("3",)


def test_a_point_out_of_reach_is_skipped_with_the_reason(tmp_path: Path) -> None:
    session = bench(tmp_path)
    session.geometry = NumericGeometry(far=cavities(TABLE)["1"])
    session.run([GO] * 9)
    assert session.marks == {("normal", "1"): Mark.SKIPPED, ("normal", "7"): Mark.DONE}
    assert "normal 1 is skipped: target is out of reach by 0.012 m" in session.told
    assert "out of reach" in (tmp_path / "s" / "journal.jsonl").read_text()


def test_jogging_takes_the_tip_down_with_the_drives_on(tmp_path: Path) -> None:
    session = bench(tmp_path, points=("1",), has_hand=False, seat="jog")
    session.arm.settle_s = 0.0
    down = SessionCommand(Do.JOG, jog=SmallMove("z", -0.02))
    too_far = [
        SessionCommand(Do.JOG, jog=SmallMove("z", -0.2)),
        SessionCommand(Do.JOG, jog=SmallMove("j2", 0.5)),
        SessionCommand(Do.JOG, jog=SmallMove("j4", 0.01)),
    ]
    turns = [SessionCommand(Do.JOG, jog=SmallMove("j1", step)) for step in (0.01, -0.01)]
    session.run([GO, GO, down, *too_far, down, down, *turns, GO, GO])
    assert "release" not in session.arm.log
    assert session.arm.log.count("creep") == 5
    assert [text.split(":")[0] for text in session.told] == ["jog z", "jog j2", "jog"]
    points, _ = read_points(tmp_path / "s" / "points.csv", 3)
    np.testing.assert_allclose(REFERENCE.tips(REFERENCE_DH, points.q_rad), points.tip_m, atol=1e-6)


def test_jog_is_refused_while_the_drives_are_off(tmp_path: Path) -> None:
    session = bench(tmp_path, points=("1",), has_hand=False)
    session.run([GO, GO, GO, SessionCommand(Do.JOG, jog=SmallMove("z", 0.01)), GO])
    assert "the drives are off: move the arm by hand; jog needs the drives on" in session.told
    assert "creep" not in session.arm.log


def test_a_tip_beside_its_cavity_shows_at_once_and_is_not_believed_after_its_redo(tmp_path: Path) -> None:
    session = bench(tmp_path, points=ALL[:8])
    session.hand = CavityHand(session.arm, {("normal", "6", 1): np.array([0.004, -0.003, 0.0])})
    session.run([GO] * 7 + [REDO] + [GO] * 5)
    suspects = [kept.record.point for kept in session.kept if kept.verdict.is_suspect]
    assert suspects == ["6"]
    assert len(session.kept) == 9
    assert 4e-3 < session.kept[5].verdict.off_m < 6e-3


def test_two_approaches_come_from_sides_that_turn_most_joints_oppositely(tmp_path: Path) -> None:
    session = bench(tmp_path, targets=board_targets(["normal"], ["1", "5", "13", "29"], approaches=2))
    session.run([GO] * 20)
    above = [np.array(tip) for tip in session.arm.tips]
    counts = []
    for name in ("1", "5", "13", "29"):
        place = np.array(cavities(TABLE)[name])
        starts = [tip for tip in above if abs(tip[2] - place[2] - 0.06) < 1e-6 and np.linalg.norm(tip - place) < 0.12]
        at = GEOMETRY.nearest(tuple(place), (0.0, -1.0, 0.0))
        turns = {tuple(np.sign(np.subtract(at, GEOMETRY.nearest(tuple(tip), at)))) for tip in starts}
        counts.append(max(sum(a * b < 0 for a, b in zip(first, second, strict=True)) for first in turns for second in turns))
    assert min(counts) >= 2
    points, _ = read_points(tmp_path / "s" / "points.csv", 3)
    assert sorted(zip(points.repeat, points.extra["approach"], strict=True)) == [(1, "1")] * 4 + [(2, "2")] * 4


def test_free_poses_are_gone_to_and_seen(tmp_path: Path) -> None:
    poses = {"f1": (0.1, -0.5, 0.4), "f2": (0.3, -0.6, 0.2)}
    session = bench(tmp_path, targets=(*board_targets(["normal"], ["1"]), *free_targets(poses)), has_camera=True)
    session.run([GO] * 9)
    points, _ = read_points(tmp_path / "s" / "points.csv", 3)
    assert points.setup == ("normal", "free", "free")
    np.testing.assert_allclose(points.q_rad[1:], list(poses.values()), atol=1e-9)
    np.testing.assert_allclose(points.tip_m, REFERENCE.tips(REFERENCE_DH, points.q_rad), atol=1e-6)


def test_on_an_unknown_board_the_arm_never_moves_by_itself(tmp_path: Path) -> None:
    session = bench(tmp_path, points=ALL[:6], has_hand=False, board="unknown")
    session.run([GO] * 40)
    assert "move" not in session.arm.log[: session.arm.log.index("done")]
    points, _ = read_points(tmp_path / "s" / "points.csv", 3)
    assert len(points) == 6
    assert np.isnan(points.tip_m).all()


def test_on_an_unknown_board_a_tip_beside_its_cavity_shows_too(tmp_path: Path) -> None:
    session = bench(tmp_path, points=ALL[::2], board="unknown")
    wrong = ("normal", ALL[20], 1)
    session.hand = CavityHand(session.arm, {wrong: np.array([0.006, 0.0, 0.004])}, moved=(0.03, -0.02, 0.01))
    session.run([GO] * 60)
    assert [kept.record.key for kept in session.kept if kept.verdict.is_suspect] == [wrong]


def test_a_board_that_is_measured_is_placed_by_spread_cavities_and_then_visited(tmp_path: Path) -> None:
    session = bench(tmp_path, points=ALL, board="measured", has_camera=True)
    session.hand = CavityHand(session.arm, moved=(0.03, -0.02, 0.01))
    session.run([GO] * 12)
    guided = [entry.split()[2] for entry in session.arm.log if entry.startswith("take")]
    places = np.array([cavities(TABLE)[name] for name in guided])
    assert len(guided) == 5
    assert np.linalg.svd(places - places.mean(axis=0))[1][1] > 0.08, "not in line, not in a corner"
    assert any("pose from 5 cavities" in text for text in session.told)
    pose = read_boards(tmp_path / "s" / "boards.json")["normal"]
    np.testing.assert_allclose(pose.origin_m, np.add(TABLE.origin_m, (0.03, -0.02, 0.01)), atol=1e-6)
    session.run([GO] * 4)  # resumed: it is placed already
    assert [entry for entry in session.arm.log if entry.startswith("take")] == [f"take normal {name}" for name in guided]


def test_an_exception_in_the_middle_lets_go_and_holds(tmp_path: Path) -> None:
    session = bench(tmp_path)
    session.arm.settle_s = 1e9
    with pytest.raises(Exception, match="does not come to rest"):
        session.run([GO] * 5)
    assert session.arm.log[-3:] == ["hold", "hold", "let go"]
