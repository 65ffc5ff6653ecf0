"""A session's folder, which is the complete state of the session.

    session.json   the plan (calib.session.plan)
    points.csv     the valid records, in the interchange format
    journal.jsonl  skipped, redone and bad points, notes; withdrawn records with their line of points.csv

A record is in points.csv, and an event in the journal, before the call returns. A withdrawn record is written to the
journal first and then removed from points.csv; after a kill in between, opening the folder completes it. Records of one
point are distinguished by `take`, so that nothing is withdrawn twice.
"""

from __future__ import annotations

import contextlib
import datetime
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from calib.errors import SessionError
from calib.points.points import Points, read_points
from calib.points.writer import DISTANCE, Key, PointsWriter, Record, replace_file
from calib.session.plan import Mark, SessionPlan, SessionState, TargetEvent, from_json, require_same, to_json
from control.files import KeptLines, parsed_json, read_text
from firmware_iface.link import Closing

Entry = dict[str, Any]


class SessionJournal(KeptLines):
    """Its entries. While it is open, no other session can open it (SessionError)."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, SessionError)
        try:
            self.entries = [self._entry(line, number) for number, line in enumerate(self.lines, start=1)]
        except SessionError:
            self.close()
            raise

    def note(self, entry: Mapping[str, Any]) -> None:
        """Write one entry and wait for the disk."""
        self.append(json.dumps(entry))
        self.entries.append(dict(entry))

    def _entry(self, line: bytes, number: int) -> Entry:
        with contextlib.suppress(ValueError):
            entry = parsed_json(line)
            if isinstance(entry, dict) and isinstance(entry.get("event"), str):
                return entry
        raise SessionError(f"{self.path}, line {number}: not a journal entry: undo manual edits")


PLAN, POINTS, JOURNAL = "session.json", "points.csv", "journal.jsonl"
AT_POINT, LIFTED = "at point", "lifted"  # journal events


class SessionFolder(Closing):
    """A session that is begun or resumed; use it as a context manager, or close it."""

    def __init__(self, folder: Path, wanted: SessionPlan | None = None) -> None:
        """Begin the session `wanted` in a new folder, or resume the one that is there.

        SessionError if there is nothing to resume, if `wanted` differs from the session in the folder,
        or if another process has it open.
        """
        self.path = folder
        self.is_resumed = (folder / PLAN).exists()
        if self.is_resumed:
            self.plan, self.started = _kept(folder, wanted)
        else:
            self.plan, self.started = _begun(folder, wanted), _now()
        self._journal = SessionJournal(folder / JOURNAL)
        try:
            if not self.is_resumed:
                replace_file(folder / PLAN, to_json(self.plan, self.started).encode())
            self._writer = PointsWriter(
                folder / POINTS, self.plan.joint_count, self.plan.pose_frame, (DISTANCE,) if self.plan.board == "contact" else ()
            )
        except BaseException:
            self._journal.close()
            raise
        self._withdrawn: Counter[Key] = Counter()
        try:
            self.state = self._restored()
        except BaseException:
            self.close()
            raise
        self.warnings = self._writer.warnings
        if self.is_resumed:
            self._note("resumed")

    @property
    def is_at_point(self) -> str:
        """The setup in which the arm was left with its tip at a point, else ""."""
        for entry in reversed(self._journal.entries):
            if entry["event"] in (AT_POINT, LIFTED):
                return str(entry["setup"]) if entry["event"] == AT_POINT else ""
        return ""

    @property
    def standing(self) -> str:
        """The last setup of the board, else ""."""
        stood = (str(e["setup"]) for e in reversed(self._journal.entries) if e["event"] in (AT_POINT, LIFTED))
        return next(stood, "")

    def points(self) -> Points | None:
        """The valid records; None if there are none yet."""
        return read_points(self.path / POINTS, self.plan.joint_count)[0] if self._writer.recorded else None

    def record(self, record: Record) -> Record:
        """Save a record of a remaining target; return it with its take."""
        after = self.state.after(TargetEvent.RECORDED, record.key)
        numbered = replace(record, take=1 + self._withdrawn[record.key])
        self._writer.append(numbered)
        self.state = after
        return numbered

    def skip(self, key: Key, reason: str = "") -> None:
        """Skip a target."""
        self.happen(TargetEvent.SKIP, key, reason)

    def happen(self, event: TargetEvent, key: Key, reason: str = "") -> None:
        """Apply SKIP, REDO or BAD: an existing record of the target is withdrawn and stays in the journal."""
        after = self.state.after(event, key)
        details = {"reason": reason} if reason else {}
        if key in self._writer.recorded:
            details["record"] = self._writer.line(key)
        self._note(event.value, **_named(key), **details)
        if key in self._writer.recorded:
            self._writer.withdraw(key)
            self._withdrawn[key] += 1
        self.state = after

    def note(self, text: str, key: Key | None = None) -> None:
        """Save a remark of the operator, with its target."""
        self._note("note", text=text, **(_named(key) if key else {}))

    def at_point(self, key: Key) -> None:
        """Note that the tip is about to be taken down to a point."""
        self._note(AT_POINT, **_named(key))

    def lifted(self, setup: str) -> None:
        """Note that the tip is clear of the board."""
        self._note(LIFTED, setup=setup)

    def close(self) -> None:
        """Close the files."""
        self._writer.close()
        self._journal.close()

    def _note(self, event: str, **details: object) -> None:
        self._journal.note({"at": _now(), "event": event, **details})

    def _restored(self) -> SessionState:
        """The state from the files, after completing withdrawals interrupted by a kill."""
        state = SessionState.begun(self.plan.targets)
        for entry in self._journal.entries:
            state = self._replayed(state, entry)
        for key in self._writer.recorded:
            state = state.marked(key, Mark.DONE)
        return state

    def _replayed(self, state: SessionState, entry: Entry) -> SessionState:
        marks = {TargetEvent.SKIP.value: Mark.SKIPPED, TargetEvent.REDO.value: Mark.LEFT, TargetEvent.BAD.value: Mark.BAD}
        if entry["event"] not in marks:
            return state
        key = (str(entry["setup"]), str(entry["point"]), int(entry["repeat"]))
        if "record" in entry:
            self._withdrawn[key] += 1
            withdrawn = self._writer.take(entry["record"])
            if key in self._writer.recorded and self._writer.take(self._writer.line(key)) == withdrawn:
                self._writer.withdraw(key)
        return state.marked(key, marks[entry["event"]])


def continues(place: Path) -> str:
    """What an operator is told where a recording ends before its end."""
    return f"the recordings are in {place}; the same command continues"


def _begun(folder: Path, wanted: SessionPlan | None) -> SessionPlan:
    if wanted is None:
        raise SessionError(f"{folder}: no session to resume: {PLAN} is missing")
    for name in (POINTS, JOURNAL):
        file = folder / name
        if file.exists() and file.stat().st_size:
            raise SessionError(f"{folder}: {file.name} exists without {PLAN}: not a session folder; name another --out")
    wanted.require_sound()
    folder.mkdir(parents=True, exist_ok=True)
    return wanted


def _kept(folder: Path, wanted: SessionPlan | None) -> tuple[SessionPlan, str]:
    file = folder / PLAN
    try:
        text = read_text(file)
    except UnicodeDecodeError as error:
        raise SessionError(f"{file}: not the plan of a session: byte {error.start} is not UTF-8 text") from None
    except OSError as error:
        raise SessionError(f"{file}: cannot be read: {error.strerror}") from None
    plan, started = from_json(text, file)
    if wanted is not None:
        require_same(plan, wanted, folder)
    return plan, started


def _named(key: Key) -> dict[str, object]:
    return {"setup": key[0], "point": key[1], "repeat": key[2]}


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
