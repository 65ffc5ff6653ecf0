"""How requests reach the runtime: one JSON object a line over its socket, or a runtime in the same process (tests, mocks).

Socket paths of this user's runtimes, so that `stop` finds all of them without knowing their arms or files.

A runtime that listens elsewhere (`--socket`) gets a link in the folder. A folder that belongs to somebody else, or that others
may write to, is not used: whoever puts a socket there would receive the operator's stop.
"""

import contextlib
import glob
import os
import socket
import stat
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

import msgspec

from control.errors import ArmError
from control.model.rules import NAME, is_file_name

Message = dict[str, Any]
CONTROL_KEY = "ARMWRIGHT_CONTROL_KEY"  # environment: clients with the same key count as one


class RuntimeGone(ArmError):
    """No runtime answers on the socket."""


class NoRuntime(RuntimeGone):
    """No runtime listens at the socket."""


class Channel(Protocol):
    """Carries a request to the runtime and its answer back."""

    def request(self, message: Message) -> Message: ...

    def wait(self, duration_s: float) -> None:
        """Let time pass on the runtime's clock."""
        ...

    def close(self) -> None: ...


class SocketChannel:
    """A channel over the runtime's local socket: one JSON object a line, both ways."""

    def __init__(self, path: Path, timeout_s: float = 2.0, served_by: str = "armwright serve") -> None:
        """`served_by`: the command that starts the runtime, for the error when there is none."""
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        whole_s = int(timeout_s)
        wait = struct.pack("@ll", whole_s, round(1e6 * (timeout_s - whole_s)))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, wait)
        try:
            self._socket.connect(str(path))  # waits in the order of coming where others connect all the time
        except OSError as error:
            self._socket.close()
            is_none = isinstance(error, FileNotFoundError | ConnectionRefusedError)
            others = [f"`--arm {name}`" for name in running_arms()]
            ask = f", or ask the one that runs: {' or '.join(others)}" if others else ""
            raise (NoRuntime if is_none else RuntimeGone)(
                f"no runtime answers at {path} ({error.strerror or error}): start one with `{served_by}`{ask}"
            ) from error
        self._socket.settimeout(timeout_s)
        try:
            require_own_runtime(self._socket, path)
        except ForeignRuntime as error:
            self._socket.close()
            raise RuntimeGone(str(error)) from None
        self._lines = self._socket.makefile("rb")
        self._asked_count = 0
        if key := os.environ.get(CONTROL_KEY):  # of the console that started this command
            self.request({"do": "control", "key": key})

    def request(self, message: Message) -> Message:
        """Send and wait for the answer. RuntimeGone if the runtime ended or does not answer in time.

        The answer to an earlier request that was interrupted is skipped: it must not be taken
        for this one.
        """
        self._asked_count += 1
        try:
            self._socket.sendall(msgspec.json.encode({**message, "id": self._asked_count}) + b"\n")
            while True:
                answer = self._answer()
                if answer.get("id", self._asked_count) == self._asked_count:
                    return answer
        except OSError as error:
            raise RuntimeGone(f"the runtime at {self._path} does not answer ({error})") from error

    def _answer(self) -> Message:
        line = self._lines.readline()
        if not line:
            raise RuntimeGone(f"the runtime at {self._path} closed the connection")
        answer: Message = msgspec.json.decode(line)
        return answer

    def wait(self, duration_s: float) -> None:
        """Wait on the host's clock."""
        import time

        time.sleep(duration_s)

    def close(self) -> None:
        """Close the connection. The runtime stops a motion that this connection started."""
        self._lines.close()
        self._socket.close()


_CREDENTIALS = struct.Struct("3i")  # pid, uid, gid: struct ucred of unix(7)


class ForeignFolder(ArmError):
    """A folder for sockets that others own or may write to."""


class ForeignRuntime(ArmError):
    """What answers at a socket runs as another user."""


def peer_uid(connection: socket.socket) -> int:
    """The user at the other end of a connected Unix socket, by the kernel."""
    sent = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return int(_CREDENTIALS.unpack(sent)[1])


def require_own_runtime(connection: socket.socket, path: Path) -> None:
    """ForeignRuntime if the runtime at the other end runs as another user; root may use every runtime."""
    if (uid := peer_uid(connection)) not in (os.getuid(), os.geteuid()) and os.geteuid() != 0:
        raise ForeignRuntime(
            f"the program that listens at {path} runs as user {uid}, not as you ({os.getuid()}): nothing was sent to it"
        )


def require_private(folder: Path) -> None:
    """ForeignFolder unless the folder is this user's, a real one, and nobody else may write to it. OSError if there is none."""
    status = folder.lstat()
    mode = stat.S_IMODE(status.st_mode)
    if not stat.S_ISDIR(status.st_mode):
        problem = "it is a link or a file, not a folder"
    elif status.st_uid != os.getuid():
        problem = f"it belongs to user {status.st_uid}, not to you ({os.getuid()})"
    elif mode & 0o022:
        problem = f"others may write to it (mode {mode:o})"
    else:
        return
    raise ForeignFolder(
        f"{folder}: not used for sockets: {problem}; whoever put it there could receive your stop. Remove it, set"
        " XDG_RUNTIME_DIR, or give --socket"
    )


def foreign_folders() -> list[ForeignFolder]:
    """What is wrong with the folders for sockets that exist; `find_sockets` leaves such a folder out."""
    wrong = []
    for folder in socket_folders():
        try:
            require_private(folder)
        except ForeignFolder as problem:
            wrong.append(problem)
        except OSError:
            continue
    return wrong


def socket_folders() -> tuple[Path, ...]:
    """$ARMWRIGHT_RUNTIME_DIR alone, or the user's runtime folder, if it exists, and the private folder under /tmp; new sockets
    go to the first.

    Both are searched: a runtime that was started by cron or over ssh may not know the first. One folder alone is for programs
    that may not reach any other arm of this user, such as tests.
    """
    if alone := os.environ.get("ARMWRIGHT_RUNTIME_DIR"):
        return (Path(alone).absolute(),)
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    private = Path(f"/tmp/armwright-{os.getuid()}")
    return (Path(runtime) / "armwright", private) if runtime else (private,)


def default_path(arm_name: str) -> Path:
    """Default socket path of an arm's runtime. ArmError for a name that leads elsewhere."""
    if not is_file_name(arm_name):
        raise ArmError(f"arm {arm_name!r}: expected {NAME.expected}; {NAME.hint}")
    return socket_folders()[0] / f"{arm_name}.sock"


def find_sockets(arm_name: str = "*") -> list[Path]:
    """All sockets of this user, or those of one arm; some may be left over from a killed runtime."""
    if arm_name != "*" and not is_file_name(arm_name):
        return []
    wanted = "*" if arm_name == "*" else glob.escape(arm_name)
    names = (f"{wanted}.sock", f"{wanted}--*.sock")
    found = [path for folder in _own_folders() for name in names for path in sorted(folder.glob(name))]
    return list(dict.fromkeys(path.resolve() for path in found if path.is_socket()))


def running_arms() -> list[str]:
    """Names of this user's arms whose runtimes answer at their default sockets."""
    names = []
    for path in find_sockets():
        with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)) as probe:
            if path.parent in socket_folders() and probe.connect_ex(str(path)) == 0:
                names.append(path.stem)
    return sorted(names)


def _own_folders() -> Iterator[Path]:
    for folder in socket_folders():
        with contextlib.suppress(OSError, ForeignFolder):
            require_private(folder)
            yield folder


@contextlib.contextmanager
def linked(path: Path, arm_name: str) -> Iterator[None]:
    """Let `find_sockets` find a socket at another path, within this context."""
    folder = socket_folders()[0]
    link = folder / f"{arm_name}--{os.getpid()}.sock"
    is_linked = False
    if path.absolute().parent != folder:
        with contextlib.suppress(OSError, ForeignFolder):  # the link is not essential
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            require_private(folder)
            link.unlink(missing_ok=True)
            link.symlink_to(path.absolute())
            is_linked = True
    try:
        yield
    finally:
        if is_linked:
            link.unlink(missing_ok=True)
