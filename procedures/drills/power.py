"""A disk that forgets: what was not forced to it before the power failed is gone, and renames that were not are undone.

The calls of the system that write are counted; at the chosen one the power fails, and nothing reaches the disk any more.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch


class PowerLost(BaseException):
    """No program survives this."""


class Disk:
    """The disk under a program, from now on; the power fails at call number `fails_at`, counted from 0."""

    def __init__(self, fails_at: int) -> None:
        self.calls = 0
        self._fails_at = fails_at
        self._kept: dict[int, tuple[str, int]] = {}  # by inode: path, bytes that are on the disk for certain
        self._renamed: dict[
            Path, bytes | None
        ] = {}  # what was under a name before, until its folder is forced

    @contextmanager
    def under(self) -> Iterator[None]:
        """Run a program on it."""
        with (
            patch.object(os, "write", self._write),
            patch.object(os, "fsync", self._fsync),
            patch.object(os, "ftruncate", self._counted(os.ftruncate)),
            patch.object(os, "unlink", self._counted(os.unlink)),
            patch.object(os, "replace", self._named(os.replace)),
            patch.object(os, "link", self._named(os.link)),
        ):
            yield

    def forget(self) -> None:
        """The power is back: leave what was on the disk for certain."""
        for name, kept in self._kept.values():
            path = Path(name)
            if path.exists() and path.stat().st_size > kept:
                os.truncate(path, kept)
        for path, before in self._renamed.items():
            if before is None:
                path.unlink(missing_ok=True)
            else:
                path.write_bytes(before)

    def _count(self) -> None:
        if self.calls >= self._fails_at:
            raise PowerLost
        self.calls += 1

    def _counted(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*given: Any, **named: Any) -> Any:
            self._count()
            return call(*given, **named)

        return counted

    def _write(self, fd: int, content: bytes, _write: Callable[[int, bytes], int] = os.write) -> int:
        state = os.fstat(fd)
        self._kept.setdefault(state.st_ino, (str(_path_of(fd)), state.st_size))
        if self.calls == self._fails_at:
            _write(fd, content[: len(content) // 2])
        self._count()
        return _write(fd, content)

    def _fsync(self, fd: int, _fsync: Callable[[int], None] = os.fsync) -> None:
        self._count()
        _fsync(fd)
        path, state = _path_of(fd), os.fstat(fd)
        if path.is_dir():
            self._renamed = {name: was for name, was in self._renamed.items() if name.parent != path}
        else:
            self._kept[state.st_ino] = (str(path), state.st_size)

    def _named(self, call: Callable[..., None]) -> Callable[..., None]:
        """A call that gives a file a name: in an open folder, if it says so."""

        def named(source: Any, goal: Any, **folders: int) -> None:
            self._count()
            folder = folders.get("dst_dir_fd")
            path = (Path() if folder is None else _path_of(folder)).resolve() / goal
            before = path.read_bytes() if path.exists() else None
            call(source, goal, **folders)
            self._renamed.setdefault(path, before)
            state = path.stat()
            # Renamed before it was forced to the disk, nothing of it is there for certain.
            self._kept[state.st_ino] = (str(path), self._kept.get(state.st_ino, ("", 0))[1])

        return named


def _path_of(fd: int) -> Path:
    return Path(f"/proc/self/fd/{fd}").readlink()
