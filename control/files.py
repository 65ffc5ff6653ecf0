"""Writes result files atomically, complete or not at all, and reads files of limited size; one error names the file.

What is read here may come from anywhere: a pipe that never ends, a device, a file of gigabytes, text nested a thousand deep.
"""

import contextlib
import errno
import json
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

T = TypeVar("T")
PROBE_bytes = 1 << 18  # size of the trial file: some full disks still accept a small one
LONGEST_NAME_bytes = 255
TEXT_MOST_bytes = 1 << 26  # of a file that is read as a whole: 64 MB; the largest of ours has some 100 kB
DEEP_KEY = re.compile(r"(?<![\w\"'-])(?:[\w\"'-]++[ \t]*+\.[ \t]*+){32}")
# A number of more digits is no float: 309 are in base 10, 256 in base 16.
LONG_INTEGER = re.compile(r"[\da-fA-F_]{256,}")
NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})


class NotWritten(OSError):
    """A file could not be written; a previous version is unchanged. `str()` names the file and the reason."""

    @classmethod
    def of(cls, error: OSError, path: Path) -> "NotWritten":
        """Make one from the system's error about `path`."""
        return cls(error.errno, error.strerror or str(error), str(path))

    def __str__(self) -> str:
        """As an operator reads it."""
        return f"{self.filename}: not written: {self.strerror}"


class NotReadable(OSError):
    """A file that is none, or is too large; `strerror` says so."""


def open_file(path: Path) -> BinaryIO:
    """Open a file for reading without waiting. NotReadable for a pipe or a device; OSError as usual."""
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    mode = os.fstat(fd).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(fd, "rb")
    os.close(fd)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise NotReadable(errno.EINVAL, "a pipe or a device, expected a file", str(path))


def read_bytes(path: Path, most_bytes: int = TEXT_MOST_bytes) -> bytes:
    """Read a whole file whose size is checked before. OSError, NotReadable if it is larger than `most_bytes`."""
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size <= most_bytes and len(content := file.read(most_bytes + 1)) <= most_bytes:
            return content
    raise NotReadable(
        errno.EFBIG, f"{1e-6 * size:.0f} MB, expected at most {1e-6 * most_bytes:.0f} MB", str(path)
    )


def read_text(path: Path, encoding: str = "utf-8", most_bytes: int = TEXT_MOST_bytes) -> str:
    """As `read_bytes`, as text with line ends as written by Python. Raises UnicodeDecodeError, too."""
    return read_bytes(path, most_bytes).decode(encoding).replace("\r\n", "\n").replace("\r", "\n")


def parsed_json(text: str | bytes) -> Any:
    """json.loads, with a ValueError for whatever is wrong: nesting beyond Python's depth, and integers beyond a float, too."""
    try:
        return json.loads(text, parse_int=_integer)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _integer(text: str) -> int:
    if LONG_INTEGER.search(text):
        raise ValueError("a number of more than 255 digits")
    return int(text)


def parsed_toml(text: str) -> dict[str, Any]:
    """tomllib.loads, with a TOMLDecodeError for whatever is nested too deeply: it needs memory by the square of the depth.

    For integers beyond a float, too.
    """
    import tomllib

    if LONG_INTEGER.search(text):
        raise tomllib.TOMLDecodeError("a number of more than 255 digits")
    if DEEP_KEY.search(text):
        raise tomllib.TOMLDecodeError("a key of more than 32 parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise tomllib.TOMLDecodeError("nested too deeply") from None


def make_whole(path: Path, write: Callable[[Path], T]) -> T:
    """Let `write` fill a temporary file beside `path`, sync it and rename it; return the result of `write`.

    On failure `path` is unchanged and the temporary file is removed. NotWritten names `path`.
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
        with contextlib.suppress(OSError):  # the original error matters more
            beside.unlink(missing_ok=True)
    return result


def make_whole_folder(path: Path, write: Callable[[Path], object]) -> None:
    """As `make_whole`, for a new folder: `write` fills a temporary one beside it, which is then renamed."""
    beside = _beside(path)
    shutil.rmtree(beside, ignore_errors=True)  # of a program that was killed
    try:
        beside.mkdir(parents=True)
        write(beside)
        beside.rename(path)
    except OSError as error:
        raise NotWritten.of(error, path) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file atomically (text as UTF-8). NotWritten names `path`."""
    written = utf_8(content) if isinstance(content, str) else content
    make_whole(path, lambda beside: beside.write_bytes(written))


def write_new(path: Path, content: str | bytes) -> None:
    """As `write_whole`, but FileExistsError if the file exists."""
    if path.exists():
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    write_whole(path, content)


def append_whole(fd: int, path: Path, content: bytes) -> None:
    """Append to the open file `path` (readable, of lines) and sync; NotWritten if not all of it fits: nothing is appended.

    A file that does not end with a line end, because an earlier piece could not be taken back, is not appended to; nor one that
    is not at `path` any more, where nobody would find it again.
    """
    if not _is_at(fd, path):
        raise NotWritten(
            errno.ENOENT, "it was removed or replaced while it was in use: put it back", str(path)
        )
    begun = os.lseek(fd, 0, os.SEEK_END)
    if begun and os.pread(fd, 1, begun - 1) != b"\n":
        raise NotWritten(errno.EIO, "its last line is incomplete; close and open it again", str(path))
    try:
        _write_all(fd, content)
        os.fsync(fd)
    except OSError as error:
        with contextlib.suppress(OSError):
            os.ftruncate(fd, begun)
        raise NotWritten.of(error, path) from error


def require_writable(folder: Path) -> None:
    """NotWritten if `folder`, which need not exist yet, cannot be written to; the trial leaves no trace."""
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
    """Encode as UTF-8; undecodable bytes of file names become their characters if valid, else U+FFFD."""
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "replace").encode()


def _beside(path: Path) -> Path:
    """A hidden name in the same folder with the same suffixes, by which writers choose a format."""
    named = path.with_name(f".partial-{path.name}")
    is_short = len(os.fsencode(named.name)) <= LONGEST_NAME_bytes
    return named if is_short else path.with_name(f".partial{path.suffix}")


def _write_all(fd: int, content: bytes) -> None:
    while content:
        content = content[os.write(fd, content) :]


def _is_at(fd: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(fd), path.stat())
    except OSError:
        return False


def _synchronise(path: Path) -> None:
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
