"""Results on the disk: whole or not at all, and one sentence that names the file where there is no room."""

import errno
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")
NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})
PROBE_bytes = 1 << 18  # written to try a place: some full disks still take a small file
LONGEST_NAME_bytes = 255


def make_whole(path: Path, write: Callable[[Path], T]) -> T:
    """Let `write` fill a file beside `path`, put it on the disk and rename it; returns what `write` returned.

    Whatever fails, `path` stays as it was and nothing is left beside it. OSError names `path`.
    """
    beside = _beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        result = write(beside)
        _synchronise(beside)
        beside.replace(path)
        _synchronise(path.parent)
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from error
    finally:
        _remove(beside)
    return result


def write_whole(path: Path, content: str | bytes) -> None:
    """The file with this content (text in UTF-8), or as it was. OSError names `path`."""
    written = content.encode() if isinstance(content, str) else content
    make_whole(path, lambda beside: beside.write_bytes(written))


def write_new(path: Path, content: str | bytes) -> None:
    """As `write_whole`, for a file that must not exist: FileExistsError where it does."""
    if path.exists():
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    write_whole(path, content)


def require_writable(folder: Path) -> None:
    """OSError where nothing can be written into `folder`, which need not exist yet; leaves no trace of the trial."""
    made = [part for part in (folder, *folder.parents) if not part.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(
            dir=folder, prefix=".armwright-", suffix=".trial", buffering=0
        ) as file:
            _write_all(file.fileno(), bytes(PROBE_bytes))
            os.fsync(file.fileno())
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(folder)) from error
    finally:
        for part in made:
            if part.is_dir() and not any(part.iterdir()):
                part.rmdir()


def _beside(path: Path) -> Path:
    """A hidden name in the same folder with the same endings, which writers choose a format by."""
    named = path.with_name(f".partial-{path.name}")
    is_short = len(os.fsencode(named.name)) <= LONGEST_NAME_bytes
    return named if is_short else path.with_name(f".partial{path.suffix}")


def _write_all(fd: int, content: bytes) -> None:
    while content:
        content = content[os.write(fd, content) :]


def _synchronise(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError:  # it is told why the file could not be written; that it could not be removed adds nothing
        return
