"""journal.jsonl: events of a session besides records, one JSON object per line, saved before `append` returns."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from calib.errors import SessionError
from control.files import KeptLines, parsed_json

Entry = dict[str, Any]


class Journal(KeptLines):
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
