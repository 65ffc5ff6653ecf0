"""What a session is: its plan, the table of its states, its folder, and that a kill at any moment loses nothing."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from calib.errors import SessionError
from calib.points.points import read_points
from calib.session.folder import SessionFolder
from calib.session.plan import (
    AFTER,
    Mark,
    SessionState,
    Target,
    TargetEvent,
    board_targets,
    fingerprint,
    free_targets,
    from_json,
    to_json,
)
from control.files import NotWritten
from control.model.arm import Camera
from control.model.description import save_arm
from tests.calib.session.session_arm import RIGHT
from tests.calib.session.session_killer import KEYS, PLAN, record
from tests.control.test_files import files_up_to


def in_state(mark: Mark) -> SessionState:
    return SessionState.begun(PLAN.targets).marked(KEYS[0], mark)


@pytest.mark.parametrize(("mark", "event"), [*itertools.product(Mark, TargetEvent)])
def test_every_event_in_every_state_does_what_the_table_says_or_is_refused(mark: Mark, event: TargetEvent) -> None:
    state = in_state(mark)
    if (mark, event) in AFTER:
        assert state.after(event, KEYS[0]).marks[KEYS[0]] is AFTER[mark, event]
    else:
        with pytest.raises(SessionError, match=f"normal 1 is {mark.value}, so not {event.value}: "):
            state.after(event, KEYS[0])
    assert state.marks[KEYS[0]] is mark, "a state never changes"


def test_the_next_target_is_the_first_left_of_the_setup_that_stands() -> None:
    state = SessionState.begun(PLAN.targets)
    assert state.next().key == KEYS[0]
    assert state.next("roll").key == KEYS[3]
    for key in KEYS[3:]:
        state = state.after(TargetEvent.RECORDED, key)
    assert state.next("roll").key == KEYS[0]
    assert state.after(TargetEvent.REDO, KEYS[4]).next("roll").key == KEYS[4]
    for key in KEYS[:3]:
        state = state.after(TargetEvent.SKIP, key)
    assert state.next() is None


def test_last_is_the_record_taken_last_and_nothing_once_it_is_withdrawn() -> None:
    state = SessionState.begun(PLAN.targets).after(TargetEvent.RECORDED, KEYS[1])
    assert state.last == KEYS[1]
    assert state.after(TargetEvent.SKIP, KEYS[0]).last == KEYS[1]
    assert state.after(TargetEvent.BAD, KEYS[1]).last is None


def test_a_point_is_named_with_all_its_repeats_or_one() -> None:
    state = SessionState.begun(board_targets(["roll"], ["7"], repeats=2, approaches=2))
    assert [key[2] for key in state.named("roll", "7")] == [1, 2, 3, 4]
    assert state.named("roll", "7", 3) == [("roll", "7", 3)]
    with pytest.raises(SessionError, match="no point roll 8; its setups are roll"):
        state.named("roll", "8")


def test_rounds_go_over_all_points_and_approaches_alternate() -> None:
    targets = board_targets(["normal"], ["1", "2"], repeats=2, approaches=2)
    assert [(t.point, t.repeat, t.approach) for t in targets] == [
        ("1", 1, 1),
        ("2", 1, 1),
        ("1", 2, 2),
        ("2", 2, 2),
        ("1", 3, 1),
        ("2", 3, 1),
        ("1", 4, 2),
        ("2", 4, 2),
    ]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"targets": ()}, "no points"),
        ({"targets": (Target("a", "1"), Target("a", "1"))}, "a 1 1 is planned twice"),
        ({"targets": (Target("a", "1\n2"),)}, "one line of text"),
        ({"board": "measured"}, "needs --camera"),
        ({"seat": "jog", "board": "unknown"}, "guide the tip by hand"),
        ({"targets": free_targets({"f1": (0.1, 0.2)})}, "add --camera"),
    ],
)
def test_a_plan_of_which_no_session_can_be_made_is_refused(tmp_path: Path, change: dict, said: str) -> None:
    with pytest.raises(SessionError, match=said):
        SessionFolder(tmp_path / "s", replace(PLAN, **change))
    assert not (tmp_path / "s").exists()


def test_a_plan_written_comes_back() -> None:
    targets = (*board_targets(["a b"], ["x,y"], 2, 2), *free_targets({"f1": (0.1, -0.25)}))
    plan = replace(PLAN, targets=targets, has_camera=True, payload_kg=0.5, board="measured")
    assert from_json(to_json(plan, "2026-11-21"), Path("session.json")) == (plan, "2026-11-21")


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"format": "session/2"}', '{"format": "session/1", "board": 3}'])
def test_a_session_json_that_is_none_is_one_error_with_the_file(text: str) -> None:
    with pytest.raises(SessionError, match=r"^session\.json"):
        from_json(text, Path("session.json"))


def test_the_fingerprint_sees_what_the_arm_is_and_not_where_it_is_plugged_in(tmp_path: Path) -> None:
    (board,) = RIGHT.encoder_boards
    elsewhere = replace(
        RIGHT, encoder_boards=(replace(board, port="COM3"),), can=None, camera=replace(RIGHT.camera or Camera(), udp_port=5)
    )
    assert fingerprint(elsewhere) == fingerprint(RIGHT)
    save_arm(RIGHT, tmp_path / "copy.toml")
    assert fingerprint(replace(RIGHT, path=tmp_path)) == fingerprint(RIGHT)
    assert fingerprint(RIGHT.with_dh(RIGHT.dh + 1e-9)) != fingerprint(RIGHT)


def test_a_session_is_resumed_as_it_was(tmp_path: Path) -> None:
    with SessionFolder(tmp_path, PLAN) as folder:
        assert not folder.is_resumed
        folder.record(record(KEYS[0]))
        folder.record(record(KEYS[1]))
        folder.skip(KEYS[2], "out of reach")
        folder.happen(TargetEvent.BAD, KEYS[1])
        folder.note("windy", KEYS[3])
        folder.at_point(KEYS[3])
        before = folder.state.marks
    with SessionFolder(tmp_path) as again:
        assert again.is_resumed
        assert again.plan == PLAN
        assert dict(again.state.marks) == dict(before)
        assert again.is_at_point == again.standing == "roll"
        again.lifted("roll")
    with SessionFolder(tmp_path, PLAN) as third:
        assert third.is_at_point == ""
        assert third.standing == "roll"


def test_a_redone_point_is_once_in_points_csv_and_every_take_of_it_is_kept(tmp_path: Path) -> None:
    with SessionFolder(tmp_path, PLAN) as folder:
        for take, q in enumerate((0.1, 0.2, 0.3), start=1):
            kept = folder.record(record(KEYS[0], q))
            assert kept.take == take
            assert folder.points().q_rad[0, 0] == pytest.approx(q)
            if take < 3:
                folder.happen(TargetEvent.REDO, KEYS[0])
                assert folder.points() is None
    points, warnings = read_points(tmp_path / "points.csv", 2)
    assert warnings == ()
    assert (points.point, points.extra["take"]) == (("1",), ("3",))
    withdrawn = [json.loads(line).get("record") for line in (tmp_path / "journal.jsonl").read_text().splitlines()]
    assert [line.split(",")[5] for line in withdrawn if line] == ["0.100000000", "0.200000000"]


def test_another_arm_or_plan_is_refused_with_what_differs(tmp_path: Path) -> None:
    with SessionFolder(tmp_path, PLAN):
        pass
    for change, said in (
        ({"arm_sha256": "11", "arm": "left"}, "session began with arm 'right'"),
        ({"payload_kg": 1.0}, r"began with payload in kg 0\.0, got 1\.0"),
        ({"targets": PLAN.targets[:4]}, "roll 2 is not in the new one"),
        ({"targets": (*PLAN.targets, Target("roll", "4"))}, "roll 4 is new"),
        ({"targets": PLAN.targets[::-1]}, "the same points in another order"),
    ):
        with pytest.raises(SessionError, match=said):
            SessionFolder(tmp_path, replace(PLAN, **change))


def test_two_sessions_cannot_share_a_folder(tmp_path: Path) -> None:
    with SessionFolder(tmp_path, PLAN), pytest.raises(SessionError, match="another program is recording into it"):
        SessionFolder(tmp_path, PLAN)
    with SessionFolder(tmp_path):
        pass


def test_a_folder_with_points_of_something_else_is_not_taken(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text("setup,point\n")
    with pytest.raises(SessionError, match=r"without session\.json"):
        SessionFolder(tmp_path, PLAN)
    with pytest.raises(SessionError, match="no session to resume"):
        SessionFolder(tmp_path / "absent")


def test_a_journal_torn_at_any_byte_is_mended_and_one_edited_is_refused(tmp_path: Path) -> None:
    with SessionFolder(tmp_path, PLAN) as folder:
        folder.skip(KEYS[0])
        folder.skip(KEYS[1])
    journal = tmp_path / "journal.jsonl"
    content = journal.read_bytes()
    whole = content.rfind(b"\n", 0, -1) + 1
    for end in range(whole + 1, len(content), 5):
        journal.write_bytes(content[:end])
        with SessionFolder(tmp_path) as again:
            assert [again.state.marks[key] for key in KEYS[:2]] == [Mark.SKIPPED, Mark.LEFT]
    journal.write_bytes(b"nonsense\n" + content)
    with pytest.raises(SessionError, match="line 1: not a journal entry"):
        SessionFolder(tmp_path)


def test_what_is_acknowledged_was_forced_to_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A kill of the machine, too: at each return the file has been synchronised as it is."""
    forced: dict[int, int] = {}

    def synchronised(file: int) -> None:
        forced[os.fstat(file).st_ino] = os.fstat(file).st_size

    monkeypatch.setattr(os, "fsync", synchronised)
    with SessionFolder(tmp_path, PLAN) as folder:
        for step in (
            lambda: folder.record(record(KEYS[0])),
            lambda: folder.happen(TargetEvent.REDO, KEYS[0]),
            lambda: folder.record(record(KEYS[0])),
            lambda: folder.note("remark"),
        ):
            step()
            for name in ("session.json", "points.csv", "journal.jsonl"):
                stat = (tmp_path / name).stat()
                assert forced.get(stat.st_ino, 0) == stat.st_size, name


@pytest.mark.parametrize("room", [0, 1, 40, 90, 160, 400])
def test_a_disk_that_fills_anywhere_loses_no_acknowledged_record_and_the_session_opens_again(tmp_path: Path, room: int) -> None:
    """The kernel's own short writes: what is refused is in no file, what was accepted in exactly one place."""
    accepted: set[tuple[str, str, int]] = set()
    with SessionFolder(tmp_path, PLAN) as folder:
        folder.record(record(KEYS[0]))
        accepted.add(KEYS[0])
        size = max((tmp_path / name).stat().st_size for name in ("points.csv", "journal.jsonl"))
        with files_up_to(size + room):
            for key in KEYS[1:4]:
                with contextlib.suppress(NotWritten):
                    folder.record(record(key))
                    accepted.add(key)
                with contextlib.suppress(NotWritten):
                    folder.note("a remark of the operator " * 4, key)
            with contextlib.suppress(NotWritten):
                folder.happen(TargetEvent.REDO, KEYS[0])
        folder.record(record(KEYS[4]))  # there is room again
        accepted.add(KEYS[4])
    with SessionFolder(tmp_path) as again:
        left = {key for key, mark in again.state.marks.items() if mark is Mark.DONE}
        assert accepted - {KEYS[0]} <= left
        assert again.warnings == ()


def test_a_line_that_could_not_be_taken_back_is_not_appended_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk took half of a record, and not its removal either: the next record would have become part of it."""
    with SessionFolder(tmp_path, PLAN) as folder:
        folder.record(record(KEYS[0]))
        monkeypatch.setattr(os, "ftruncate", lambda fd, size: (_ for _ in ()).throw(OSError(5, "I/O error")))
        size = (tmp_path / "points.csv").stat().st_size
        with files_up_to(size + 20), pytest.raises(NotWritten):
            folder.record(record(KEYS[1]))
        with pytest.raises(NotWritten, match="its last line is incomplete"):
            folder.record(record(KEYS[2]))
    monkeypatch.undo()
    with SessionFolder(tmp_path) as again:
        assert [key for key, mark in again.state.marks.items() if mark is Mark.DONE] == [KEYS[0]]
        again.record(record(KEYS[1]))


def test_a_kill_before_any_line_of_the_writing_code_loses_nothing_that_was_acknowledged(tmp_path: Path) -> None:
    """Real processes and SIGKILL, one before every 11th line that what writes runs: each is resumed, nothing is missing."""
    killer = Path(__file__).parent / "session_killer.py"
    ended = subprocess.run(
        [sys.executable, "-W", "ignore", str(killer), str(tmp_path), "11"],
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert ended.returncode == 0, ended.stderr
    assert int(ended.stdout) > 30  # sessions that were killed
