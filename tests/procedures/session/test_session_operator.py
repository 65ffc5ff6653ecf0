"""The operator's side of a session: what is understood, what is drawn, which free poses are chosen."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.calibration.owned_arms import _pictured, _shows_board
from calib.errors import SessionError
from calib.points.writer import Record
from calib.session.conduct import Boards
from calib.session.conversation import Ask, Do, Message, Recorded, SessionCommand, SessionQuestion, SmallMove
from calib.session.folder import SessionFolder
from calib.session.moves import chosen_free_poses, read_free_poses
from calib.session.plan import Mark, SessionPlan, SessionState, board_targets, free_targets
from calib.session.residual_watch import RecordVerdict
from console.main import main
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Link
from control.model.description import load_arm
from control.model.table import board_cavities, table_of
from hil_mocks.scenario import load_scenario
from procedures.session_operator import (
    HELP,
    Auto,
    BadCommand,
    BoardWords,
    OperatorView,
    SessionOperator,
    board_text,
    parse_command,
    status_text,
)

RIGHT = load_arm("right")
CAVITIES = board_cavities(table_of(RIGHT))


@pytest.mark.parametrize(
    ("line", "meant"),
    [
        ("", SessionCommand(Do.GO)),
        ("  \n", SessionCommand(Do.GO)),
        ("redo", SessionCommand(Do.REDO)),
        ("Redo 7", SessionCommand(Do.REDO, point="7")),
        ("bad roll 7", SessionCommand(Do.BAD, "roll", "7")),
        ("skip roll 7 2", SessionCommand(Do.SKIP, "roll", "7", 2)),
        ('redo "tilt a" "x 1"', SessionCommand(Do.REDO, "tilt a", "x 1")),
        ("note tip wobbled at 7", SessionCommand(Do.NOTE, text="tip wobbled at 7")),
        ("jog z -5", SessionCommand(Do.JOG, jog=SmallMove("z", -0.005))),
        ("jog j2 +90", SessionCommand(Do.JOG, jog=SmallMove("j2", math.pi / 2))),
        ("quit", SessionCommand(Do.QUIT)),
        ("help", OperatorView.HELP),
        ("?", OperatorView.HELP),
        ("status", OperatorView.STATUS),
        ("board", OperatorView.BOARD),
        ("auto", Auto(None)),
        ("auto 3", Auto(3)),
    ],
)
def test_every_command_is_understood(line: str, meant: object) -> None:
    assert parse_command(line) == meant


@pytest.mark.parametrize(
    "line",
    ["yes", "jog", "jog z", "jog z much", "jog z nan", "note", "redo a b c d", "redo a b zero", "auto -1", "quit now", 'bad "7'],
)
def test_what_is_no_command_is_refused_and_does_nothing(line: str) -> None:
    with pytest.raises(BadCommand):
        parse_command(line)


def test_help_names_every_command() -> None:
    assert all(f"  {do.value}" in HELP for do in Do if do is not Do.GO)
    assert all(view.value in HELP for view in OperatorView if view is not OperatorView.HELP)


def test_the_board_is_drawn_with_what_became_of_every_cavity() -> None:
    targets = board_targets(["normal"], list(CAVITIES))
    state = SessionState.begun(targets)
    for point, mark in (("1", Mark.DONE), ("2", Mark.DONE), ("3", Mark.BAD), ("4", Mark.SKIPPED)):
        state = state.marked(("normal", point, 1), mark)
    drawn = board_text(state, CAVITIES, "normal", targets[4]).splitlines()
    grid = "\n".join(drawn[1:-1])
    assert [grid.count(sign) for sign in "#x-O."] == [2, 1, 1, 1, 28]
    rows = [row for row in drawn[1:-1] if "#" in row]
    assert rows[-1].rstrip().endswith("#"), "cavity 1 is the rightmost of the middle row"
    assert all(len(row) <= 70 for row in drawn)


def test_a_cavity_with_some_repeats_done_is_drawn_so() -> None:
    state = SessionState.begun(board_targets(["normal"], ["1", "9"], repeats=2)).marked(("normal", "1", 1), Mark.DONE)
    assert "+" in "".join(board_text(state, CAVITIES, "normal", None).splitlines()[:-1])
    assert "no cavities" in board_text(state, CAVITIES, "roll", None)


def test_the_status_counts_and_names_what_is_not_done() -> None:
    state = SessionState.begun((*board_targets(["roll"], ["1", "2", "3"], 2), *free_targets({"f1": (0.0,)})))
    for key, mark in ((("roll", "1", 1), Mark.DONE), (("roll", "2", 2), Mark.BAD), (("roll", "3", 1), Mark.SKIPPED)):
        state = state.marked(key, mark)
    assert status_text(state) == (
        "  setup roll: 3 left, 1 done, 1 skipped, 1 bad (skipped: 3; bad: 2 (repeat 2))\n  free poses: 1 left\n"
    )


def test_free_poses_are_spread_clear_of_the_table_and_always_the_same() -> None:
    poses = chosen_free_poses(RIGHT, 12)
    assert list(poses) == [f"f{k}" for k in range(1, 13)]
    assert poses == chosen_free_poses(RIGHT, 12)
    q_rad = np.array(list(poses.values()))
    limits = np.array(RIGHT.limits_rad)
    assert ((q_rad > limits[:, 0]) & (q_rad < limits[:, 1])).all()
    ways = np.concatenate([np.linspace(a, b, 50) for a, b in itertools.pairwise(q_rad)])
    kinematics = ForwardKinematics(RIGHT)
    assert kinematics.tips(q_rad)[:, 2].min() > 0.119
    assert kinematics.tips(ways)[:, 2].min() > 0.05, "on the way from one to the next, too"
    apart = np.linalg.norm(q_rad[:, None] - q_rad[None], axis=2) + 9.0 * np.eye(12)
    assert apart.min() > 0.8


def test_poses_around_one_that_a_webcam_sees_show_it_the_board_too() -> None:
    """On an SO-101 in front of a webcam; without `seen_rad` some seven of 70 poses do."""
    arm = load_arm("so101")
    pictured = _pictured(arm, load_scenario("ideal"))
    seen_rad = (0.55, -0.95, 1.24, 0.03, 1.38)
    assert _shows_board(pictured, seen_rad)
    shown = [
        sum(_shows_board(pictured, pose) for pose in chosen_free_poses(arm, 70, around).values()) for around in (None, seen_rad)
    ]
    assert shown[0] < 12
    assert shown[1] > 40


@pytest.mark.parametrize(("seen", "said"), [("0.5 0.1", "expected 5 joint angles"), ("0 0 0 0 9", "--seen")])
def test_a_seen_pose_that_cannot_be_is_refused(seen: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = f"session --arm so101 --mock --free 5 --pictures --seen {seen} --out {tmp_path / 's'}"
    assert main(line.split()) == 2
    assert said in capsys.readouterr().err


def in_modified_dh(arm: Arm) -> Arm:
    """The same arm written by Craig's convention: each link takes L and alpha of the one before it."""
    before = [Link("fixed", 0.0, 0.0, 0.0, 0.0), *arm.links]
    rows = [
        replace(link, L_m=last.L_m, alpha_rad=last.alpha_rad, mass_kg=None, com_m=None, inertia_kg_m2=None)
        for last, link in itertools.pairwise(before)
    ]
    return replace(arm, dh_convention="modified", links=tuple(rows))


def test_free_poses_do_not_depend_on_how_the_arm_is_written_down() -> None:
    assert chosen_free_poses(in_modified_dh(RIGHT), 12) == chosen_free_poses(RIGHT, 12)


def test_free_poses_of_a_file_are_read_strictly(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("point,q1_rad,q2_rad\na,0.1,0.2\n,0.3,0.4\n")
    assert read_free_poses(path, 2) == {"a": (0.1, 0.2), "f2": (0.3, 0.4)}
    for text, said in (
        ("point,q1_rad\n", "line 1: joint angles of 1 joints, expected 2"),
        ("q1_rad,q2_rad\n0.1,x\n", 'line 2, column q2_rad: got "x", expected an angle in radians'),
        ("q1_rad,q2_rad\n0.1,45\n", "expected an angle in radians"),
        ("point,q1_rad,q2_rad\na,1,1\na,1,1\n", "pose a appears twice"),
    ):
        path.write_text(text)
        with pytest.raises(SessionError, match=said):
            read_free_poses(path, 2)


def talked(tmp_path: Path, lines: list[str], may_auto: bool, surprise: float = 1.0) -> tuple[list[SessionCommand], list[str]]:
    """What an operator's lines answer to three points and the end, and what was said."""
    plan = SessionPlan("right", "00", 3, board_targets(["normal"], ["1", "2", "3"]))
    answers: list[SessionCommand] = []
    said: list[str] = []

    def talk():
        for target in plan.targets:
            answers.append((yield Ask(SessionQuestion.NEXT, target)))
            record = Record(*target.key, (0.1,) * 3, (0.0,) * 3, (0,) * 3, (0.0,) * 3, 0.0, 0.0, None)
            yield Recorded(record, RecordVerdict(np.full(3, 0.01), 0.004, surprise if target.point == "2" else 1.0))
        yield Message("all is well")
        answers.append((yield Ask(SessionQuestion.DONE, None)))

    with SessionFolder(tmp_path, plan) as folder:
        words = BoardWords(plan, Boards(RIGHT, plan).cavities_m, None)
        SessionOperator(folder, words, iter(lines), said.append, may_auto=may_auto).run(talk())
    return answers, said


def test_the_operator_is_asked_told_and_obeyed(tmp_path: Path) -> None:
    answers, said = talked(tmp_path, ["what", "auto", "help", "board", "", "redo", "note x"], may_auto=False)
    assert [command.do for command in answers] == [Do.GO, Do.REDO, Do.NOTE, Do.QUIT]
    assert said[0] == "[1/3] normal 1: hands off; Enter moves the arm to above the cavity >"
    assert said[1] == "! unknown command: 'what'; `help` lists the commands"
    assert said[2] == "! auto: only a session with a mock arm can answer automatically"
    assert said[3] == HELP
    assert "normal 1 recorded; model error 17.32 mm, 4.00 mm from the prediction of the earlier points" in said
    assert "all is well" in said


def test_going_on_by_itself_ends_where_something_looks_wrong(tmp_path: Path) -> None:
    answers, said = talked(tmp_path / "a", ["auto"], may_auto=True, surprise=7.0)
    assert [command.do for command in answers] == [Do.GO, Do.GO, Do.QUIT, Do.GO]
    assert any(text.startswith("! normal 2 recorded") and "7 standard deviations" in text for text in said)
    assert [c.do for c in talked(tmp_path / "b", ["auto"], may_auto=True)[0]] == [Do.GO] * 4
    assert [c.do for c in talked(tmp_path / "c", ["auto 2"], may_auto=True)[0]] == [Do.GO, Do.GO, Do.QUIT, Do.GO]
