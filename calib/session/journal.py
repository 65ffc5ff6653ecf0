"""journal.jsonl: events of a session besides records, one JSON object per line, saved before `append` returns."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from calib.errors import SessionError
from control.files import append_whole, open_to_append, parsed_json, read_bytes

Entry = dict[str, Any]


class Journal:
    """Appends entries; an incomplete last line, left by a killed process, is dropped on opening.

    While it is open, no other session can open it (SessionError).
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file = open_to_append(path, is_alone=True)
        except BlockingIOError as error:
            raise SessionError(f"{path.parent}: another session is running in this folder") from error
        try:
            self.entries: tuple[Entry, ...] = self._mended()
        except SessionError:
            self._file.close()
            raise

    def append(self, entry: Mapping[str, Any]) -> None:
        """Write one entry and wait for the disk."""
        append_whole(self._file.fileno(), self._path, json.dumps(entry).encode() + b"\n")
        self.entries += (dict(entry),)

    def close(self) -> None:
        """Close the file and let others open it."""
        self._file.close()

    def _mended(self) -> tuple[Entry, ...]:
        content = read_bytes(self._path)
        whole = content[: content.rfind(b"\n") + 1]
        if len(whole) < len(content):
            self._file.truncate(len(whole))
            os.fsync(self._file.fileno())
        return tuple(self._entry(line, number) for number, line in enumerate(whole.splitlines(), start=1))

    def _entry(self, line: bytes, number: int) -> Entry:
        with contextlib.suppress(ValueError):
            entry = parsed_json(line)
            if isinstance(entry, dict) and isinstance(entry.get("event"), str):
                return entry
        raise SessionError(f"{self._path}, line {number}: not a journal entry: undo manual edits")
