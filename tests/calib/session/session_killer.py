"""A session that is killed with SIGKILL before a given line of the code that writes, resumed, and looked at; a program of its own
so that it can fork before anything has threads.
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from calib.points.writer import Key, Record
from calib.session.folder import SessionFolder
from calib.session.plan import Mark, SessionPlan, TargetEvent, board_targets

PLAN = SessionPlan("right", "00", 2, board_targets(["normal", "roll"], ["1", "2", "3"]))
KEYS = [target.key for target in PLAN.targets]
REDONE, SKIPPED, BAD = KEYS[1], KEYS[2], KEYS[4]
WATCHED = ("session/folder.py", "session/journal.py", "points/writer.py")
WHOLE = [Mark.DONE, Mark.DONE, Mark.SKIPPED, Mark.DONE, Mark.BAD, Mark.DONE]
# After an acknowledgement the killed session may have gone on, but not back.
MAY_FOLLOW = {"record": {Mark.DONE}, "redo": {Mark.LEFT, Mark.DONE}, "skip": {Mark.SKIPPED}, "bad": {Mark.BAD}}
Acknowledge = Callable[[str, Key], None]


def record(key: Key, q: float = 0.1) -> Record:
    """A record of an arm with two joints."""
    return Record(*key, (q, 0.2), (1e-5, 1e-5), (1, -1), (0.2, 1.4), 0.0, 0.0, (0.5, 0.0, 0.0), (25.0, 25.0))


def take_session(path: Path, acknowledge: Acknowledge) -> None:
    """Records with two redos, a skip, a bad one, from wherever it stands to the end; acknowledges what has returned."""
    with SessionFolder(path, PLAN) as folder:
        if folder.state.marks[SKIPPED] is Mark.LEFT:
            folder.skip(SKIPPED)
            acknowledge("skip", SKIPPED)
        if folder.state.marks[BAD] is Mark.DONE:  # killed between the two
            folder.happen(TargetEvent.BAD, BAD)
        while (target := folder.state.next()) is not None:
            kept = folder.record(record(target.key))
            acknowledge("record", target.key)
            if target.key == REDONE and kept.take < 3:
                folder.happen(TargetEvent.REDO, REDONE)
                acknowledge("redo", REDONE)
            if target.key == BAD:
                folder.happen(TargetEvent.BAD, BAD)
                acknowledge("bad", BAD)


def killed_before(line: int, path: Path) -> tuple[dict[Key, str], bool]:
    """Take the session in a child that dies before the given line; its last acknowledgement by key, and whether it died."""
    out, into = os.pipe()
    pid = os.fork()
    if pid == 0:
        _die_before(line)
        take_session(path, lambda what, key: _say(into, what, key))
        os._exit(0)
    os.close(into)
    with os.fdopen(out) as said:
        lines = [text.split() for text in said.read().splitlines()]
    status = os.waitpid(pid, 0)[1]
    if status and not (os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL):
        raise SystemExit(f"the session before line {line} ended with {status}")
    return {(setup, point, 1): what for what, setup, point in lines}, status != 0


def _say(into: int, what: str, key: Key) -> None:
    os.write(into, f"{what} {key[0]} {key[1]}\n".encode())


def _die_before(line: int) -> None:
    count = itertools.count()

    def per_line(frame, event, argument):
        if event == "line" and next(count) == line:
            os.kill(os.getpid(), signal.SIGKILL)
        return per_line

    sys.settrace(lambda frame, event, argument: per_line if frame.f_code.co_filename.endswith(WATCHED) else None)


def check(path: Path, acknowledged: dict[Key, str]) -> None:
    """What was acknowledged is on the disk, and points.csv holds what the marks say."""
    with SessionFolder(path, PLAN) as folder:
        marks, points = folder.state.marks, folder.points()
    for key, what in acknowledged.items():
        allowed = MAY_FOLLOW[what]
        if what == "record" and key == REDONE:
            allowed = {Mark.DONE, Mark.LEFT}  # the redo after it may be on the disk already
        if what == "record" and key == BAD:
            allowed = {Mark.DONE, Mark.BAD}
        if marks[key] not in allowed:
            raise SystemExit(f"{path}: {key} was acknowledged as {what} and is {marks[key]}")
    lines = (path / "points.csv").read_text().splitlines()
    for entry in (path / "journal.jsonl").read_text().splitlines():
        if json.loads(entry).get("record") in lines:
            raise SystemExit(f"{path}: a record that was withdrawn is in points.csv: {entry}")
    held = set(zip(points.setup, points.point, points.repeat, strict=True)) if points else set()
    if held != {key for key, mark in marks.items() if mark is Mark.DONE}:
        raise SystemExit(f"{path}: points.csv holds {held}, marks are {marks}")


def main(root: Path, stride: int) -> None:
    """Kill before line 1, 1 + stride, ... until a session lives to its end; prints how many were killed."""
    for kills in itertools.count():
        path = root / str(kills)
        acknowledged, was_killed = killed_before(1 + kills * stride, path)
        if (path / "session.json").exists():
            check(path, acknowledged)
        elif acknowledged:
            raise SystemExit(f"{path}: {acknowledged} was acknowledged and there is no session")
        take_session(path, lambda what, key: None)
        with SessionFolder(path) as ended:
            if list(ended.state.marks.values()) != WHOLE:
                raise SystemExit(f"{path}: resumed to {ended.state.marks}")
        if not was_killed:
            sys.stdout.write(f"{kills}\n")
            return


if __name__ == "__main__":
    os.fsync = lambda file: None  # a killed process leaves its files to the system, which goes on: this saves seconds
    main(Path(sys.argv[1]), int(sys.argv[2]))
