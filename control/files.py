"""Writes result files atomically, complete or not at all, and reads files of limited size; one error names the file.

What is read here may come from anywhere: a pipe that never ends, a device, a file of gigabytes, text nested a thousand deep.
"""

import contextlib
import errno
import fcntl
import io
import itertools
import json
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")
PROBE_bytes = 1 << 18  # size of the trial file: some full disks still accept a small one
APART = ".partial-"  # begins the names of folders in which files are made
TEXT_MOST_bytes = 1 << 26  # of a file that is read as a whole: 64 MB; the largest of ours has some 100 kB
TOML_MOST_characters = 1 << 20  # the largest of ours, with maps, has some 100 kB
DEEP_KEY = re.compile(r"(?<![\w\"'-])(?:[\w\"'-]++[ \t]*+\.[ \t]*+){32}")
# A number of more digits is no float: 309 are in base 10, 256 in base 16.
LONG_INTEGER = re.compile(r"[\da-fA-F_]{256,}")
NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})
WRONG_PLACE = frozenset({errno.EACCES, errno.EISDIR, errno.ENAMETOOLONG, errno.ENOTDIR, errno.EPERM, errno.EROFS})


class NotWritten(OSError):
    """A file could not be written; a previous version is unchanged. `str()` names the file and the reason."""

    @classmethod
    def of(cls, error: OSError, path: Path) -> "NotWritten":
        """Make one from the system's error about `path`."""
        return cls(error.errno, error.strerror or str(error), str(path))

    def __str__(self) -> str:
        """As an operator reads it; with another place as the remedy where it is one."""
        remedy = ": free some space, or choose another place" if self.errno in NO_ROOM else ""
        remedy = ": choose another place" if self.errno in WRONG_PLACE else remedy
        return f"{self.filename}: not written: {self.strerror}{remedy}"


class NotReadable(OSError):
    """A file that is none, or is too large; `strerror` says so."""


def open_file(path: Path) -> io.BufferedReader:
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
    raise NotReadable(errno.EFBIG, f"{1e-6 * size:.0f} MB, expected at most {1e-6 * most_bytes:.0f} MB", str(path))


def read_text(path: Path) -> str:
    """As `read_bytes`, as text without a byte-order mark, line ends as written by Python. Raises UnicodeDecodeError, too."""
    return read_bytes(path).decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")


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

    For integers beyond a float, and for text that would take it more than some seconds, too.
    """
    import tomllib

    if len(text) > TOML_MOST_characters:
        raise tomllib.TOMLDecodeError(f"{1e-6 * len(text):.1f} MB, expected at most {1e-6 * TOML_MOST_characters:.0f} MB of TOML")
    if LONG_INTEGER.search(text):
        raise tomllib.TOMLDecodeError("a number of more than 255 digits")
    if DEEP_KEY.search(text):
        raise tomllib.TOMLDecodeError("a key of more than 32 parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise tomllib.TOMLDecodeError("nested too deeply") from None


def read_toml(path: Path, wrong: Callable[[str], Exception], remedy: str = "", may_be_absent: bool = False) -> dict[str, Any]:
    """The document of a file. `wrong` makes the caller's error of the text that names file and reason, and ends with `remedy`.

    may_be_absent: a file that is not there is empty.
    """
    import tomllib

    try:
        return parsed_toml(read_text(path))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise wrong(f"{path}: not valid TOML: {error}; correct it, or give another file") from None
    except OSError as error:
        if may_be_absent and isinstance(error, FileNotFoundError):
            return {}
        raise wrong(f"{path}: cannot be read: {error.strerror}{remedy}") from None


def make_whole(path: Path, write: Callable[[Path], T], is_new: bool = False) -> T:
    """Let `write` fill a file of this name elsewhere, sync it and put it in place; return the result of `write`.

    On failure `path` is unchanged. NotWritten names `path`; FileExistsError, if it is to be new and is there already.
    """
    with _in_place_of(path, is_new) as apart:
        result = write(apart)
        _synchronise(apart)
    return result


def make_whole_folder(path: Path, write: Callable[[Path], object]) -> None:
    """As `make_whole`, for a new folder."""
    with _in_place_of(path) as apart:
        apart.mkdir()
        write(apart)


def write_whole(path: Path, content: str | bytes, is_new: bool = False) -> None:
    """Write a file atomically (text as UTF-8); errors as of `make_whole`."""
    written = utf_8(content) if isinstance(content, str) else content
    make_whole(path, lambda apart: apart.write_bytes(written), is_new)


@contextlib.contextmanager
def _in_place_of(path: Path, is_new: bool = False) -> Iterator[Path]:
    """A path in a folder of ours beside `path`; what is there at the end of the block takes the place of `path`.

    Others may write to the folder of `path`, too. They cannot prepare a link under a name that they do not know, nor put
    another folder in the place of ours: it is reached by its descriptor. The lock tells that of a running program from what
    a killed one has left.
    """
    with contextlib.ExitStack() as closing:
        try:
            with contextlib.suppress(FileExistsError):  # what is there and no folder, the next line names
                path.parent.mkdir(parents=True, exist_ok=True)
            here = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
            closing.callback(os.close, here)
            _clear_away(here)
            folder = f"{APART}{os.urandom(8).hex()}"
            os.mkdir(folder, 0o700, dir_fd=here)
            closing.callback(shutil.rmtree, folder, ignore_errors=True, dir_fd=here)
            ours = _open_own(folder, here)
            closing.callback(os.close, ours)
            with contextlib.suppress(OSError):  # network file systems lock no folders
                fcntl.flock(ours, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield Path(f"/proc/self/fd/{ours}") / path.name
            _put(path.name, ours, here, is_new)
            os.fsync(here)
        except OSError as error:
            if is_new and error.errno == errno.EEXIST:
                raise FileExistsError(error.errno, error.strerror, str(path)) from None
            raise NotWritten.of(error, path) from error


def _put(name: str, source: int, goal: int, is_new: bool) -> None:
    """Move a file or a folder from one open folder to another. FileExistsError, if it is to be new and is there already."""
    if is_new:
        try:
            os.link(name, name, src_dir_fd=source, dst_dir_fd=goal)
            return
        except FileExistsError:
            raise
        except OSError:  # a file system without links
            os.close(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, dir_fd=goal))
    os.replace(name, name, src_dir_fd=source, dst_dir_fd=goal)


def _open_own(name: str, here: int) -> int:
    """Open a folder that is this user's alone. OSError."""
    fd = os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=here)
    state = os.fstat(fd)
    if state.st_uid == os.geteuid() and not state.st_mode & 0o077:
        return fd
    os.close(fd)
    raise PermissionError(errno.EPERM, "another user put a folder of theirs in the place of ours")


def _clear_away(here: int) -> None:
    """Remove what killed programs of this user have left."""
    for name in [name for name in os.listdir(here) if name.startswith(APART)]:
        with contextlib.suppress(OSError), contextlib.ExitStack() as closing:
            closing.callback(os.close, fd := _open_own(name, here))
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(name, ignore_errors=True, dir_fd=here)


@contextlib.contextmanager
def changing(path: Path) -> Iterator[None]:
    """Let nobody else change `path`, which need not exist yet, between reading it and writing it again; waits for others.

    The lock is on the file itself, and of no use once another has taken its place. One that is still empty goes again.
    """
    while True:
        with open_to_append(path) as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            if not _is_at(file.fileno(), path):
                continue
            try:
                yield
            finally:
                if _is_at(file.fileno(), path) and not path.stat().st_size:
                    path.unlink()
            return


def open_to_append(path: Path, is_alone: bool = False) -> io.FileIO:
    """Open a file, or make it and its folder, for `append_whole`. A link is followed if it is this user's.

    NotWritten; BlockingIOError, if another program has it open `is_alone`.
    """
    try:
        if path.is_symlink() and path.lstat().st_uid == os.geteuid():
            path = path.resolve()
        with contextlib.suppress(FileExistsError):  # what is there and no folder, the next line names
            path.parent.mkdir(parents=True, exist_ok=True)
        flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        file = io.FileIO(os.open(path, flags, 0o666), "a+")
    except OSError as error:
        raise NotWritten.of(error, path) from error
    if is_alone:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
            raise
    return file


def append_whole(fd: int, path: Path, content: bytes) -> None:
    """Append to the open file `path` (readable, of lines) and sync; NotWritten if not all of it fits: nothing is appended.

    A file that does not end with a line end, because an earlier piece could not be taken back, is not appended to; nor one that
    is not at `path` any more, where nobody would find it again.
    """
    if not _is_at(fd, path):
        raise NotWritten(None, "it was removed or replaced while it was in use: put it back", str(path))
    begun = os.lseek(fd, 0, os.SEEK_END)
    if begun and os.pread(fd, 1, begun - 1) != b"\n":
        raise NotWritten(None, "its last line is incomplete; close and open it again", str(path))
    try:
        _write_all(fd, content)
        os.fsync(fd)
    except OSError as error:
        with contextlib.suppress(OSError):
            os.ftruncate(fd, begun)
        raise NotWritten.of(error, path) from error


class KeptLines:
    """A file of lines that this program alone appends to; a line is on the disk before `append` returns.

    An end without a line end, left by a killed process, is dropped: `torn`. Lines that were acknowledged are whole, and stay.
    `lines` are those that were there, without the header.
    """

    def __init__(self, path: Path, error: type[Exception], header: str = "") -> None:
        """Open the file, or make it with its header. `error`: another program has it open, or its columns are others."""
        self.path, self._error = path, error
        self._file = self._opened()
        try:
            content = read_bytes(path)
            end = content.rfind(b"\n") + 1
            lines, self.torn = content[:end].split(b"\n")[:-1], content[end:]
            if header and lines:
                self._require_columns(header, lines[0])
            if self.torn:
                self._file.truncate(end)
            if header and not lines:
                self.append(header)
            self.lines = lines[1:] if header else lines
        except BaseException:
            self._file.close()
            raise

    def append(self, *lines: str) -> None:
        """Write lines and wait for the disk."""
        append_whole(self._file.fileno(), self.path, "".join(f"{line}\n" for line in lines).encode())

    def replace(self, *lines: str) -> None:
        """Put a file of other lines, header first, in its place. NotWritten: the old one stays in use."""
        write_whole(self.path, "".join(f"{line}\n" for line in lines))
        self._file.close()
        self._file = self._opened()

    def close(self) -> None:
        """Close the file and let others open it."""
        self._file.close()

    def _opened(self) -> io.FileIO:
        try:
            return open_to_append(self.path, is_alone=True)
        except BlockingIOError:
            raise self._error(f"{self.path}: another program is recording into it") from None

    def _require_columns(self, header: str, there: bytes) -> None:
        got = there.decode(errors="replace").strip()
        for a, b in itertools.zip_longest(header.split(","), got.split(","), fillvalue="none"):
            if a != b:
                raise self._error(
                    f"{self.path}, line 1: recorded otherwise: expected column {a}, got {b}: name another file or folder"
                )


def require_writable(folder: Path) -> None:
    """NotWritten if `folder`, which need not exist yet, cannot be written to; the trial leaves no trace."""
    made = [part for part in (folder, *folder.parents) if not part.exists()]
    try:
        with contextlib.suppress(FileExistsError):  # what is there and no folder, the next line names
            folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".armwright-", suffix=".trial", buffering=0) as file:
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
