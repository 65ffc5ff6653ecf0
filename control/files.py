"""Results on the disk: whole or not at all, and one sentence that names the file where there is no room."""

import contextlib
import errno
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")
PROBE_bytes = 1 << 18  # written to try a place: some full disks still take a small file
LONGEST_NAME_bytes = 255
NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})


class NotWritten(OSError):
    """A file that could not be written; what stood there before is as it was. `str()` names the file and says why."""

    @classmethod
    def of(cls, error: OSError, path: Path) -> "NotWritten":
        """What the system said of `path`."""
        return cls(error.errno, error.strerror or str(error), str(path))

    def __str__(self) -> str:
        """As an operator reads it."""
        return f"{self.filename}: not written: {self.strerror}"


def make_whole(path: Path, write: Callable[[Path], T]) -> T:
    """Let `write` fill a file beside `path`, put it on the disk and rename it; returns what `write` returned.

    Whatever fails, `path` stays as it was and nothing is left beside it. NotWritten names `path`.
    """
    beside = _beside(path)
    try:
        result = write(beside)
        _synchronise(beside)
        beside.replace(path)
        _synchronise(path.parent)
    except OSError as error:
        raise NotWritten.of(error, path) from error
    finally:
        with contextlib.suppress(OSError):  # why the file was not written is what counts
            beside.unlink(missing_ok=True)
    return result


def write_whole(path: Path, content: str | bytes) -> None:
    """The file with this content (text in UTF-8), or as it was. NotWritten names `path`."""
    written = utf_8(content) if isinstance(content, str) else content
    make_whole(path, lambda beside: beside.write_bytes(written))


def write_new(path: Path, content: str | bytes) -> None:
    """As `write_whole`, for a file that must not exist: FileExistsError where it does."""
    if path.exists():
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    write_whole(path, content)


def append_whole(fd: int, path: Path, content: bytes) -> None:
    """Append to the open file `path` and wait for the disk; NotWritten where not all of it fits, and then none is there."""
    begun = os.lseek(fd, 0, os.SEEK_END)
    try:
        _write_all(fd, content)
        os.fsync(fd)
    except OSError as error:
        with contextlib.suppress(OSError):
            os.ftruncate(fd, begun)
        raise NotWritten.of(error, path) from error


def require_writable(folder: Path) -> None:
    """NotWritten where nothing can be written into `folder`, which need not exist yet; leaves no trace of the trial."""
    made = [part for part in (folder, *folder.parents) if not part.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(
            dir=folder, prefix=".armwright-", suffix=".trial", buffering=0
        ) as file:
            _write_all(file.fileno(), bytes(PROBE_bytes))
            os.fsync(file.fileno())
    except OSError as error:
        raise NotWritten.of(error, folder) from error
    finally:
        for part in made:
            if part.is_dir() and not any(part.iterdir()):
                part.rmdir()


def utf_8(text: str) -> bytes:
    """The text in UTF-8, with whatever bytes of file names it carries: as the characters that they are, else as U+FFFD."""
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "replace").encode()


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
