"""Socket paths of this user's runtimes, so that `stop` finds all of them without knowing their arms or files.

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

from control.errors import ArmError
from control.model.rules import NAME, is_file_name

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
    found = folder.lstat()
    mode = stat.S_IMODE(found.st_mode)
    if not stat.S_ISDIR(found.st_mode):
        problem = "it is a link or a file, not a folder"
    elif found.st_uid != os.getuid():
        problem = f"it belongs to user {found.st_uid}, not to you ({os.getuid()})"
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
    """The user's runtime folder, if it exists, and the private folder under /tmp; new sockets go to the first.

    Both are searched: a runtime that was started by cron or over ssh may not know the first.
    """
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
    found = []
    for path in find_sockets():
        with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)) as probe:
            if path.parent in socket_folders() and probe.connect_ex(str(path)) == 0:
                found.append(path.stem)
    return sorted(found)


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
