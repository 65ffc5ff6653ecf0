"""Socket paths of this user's runtimes, so that `stop` finds all of them without knowing their arms or files.

A runtime that listens elsewhere (`--socket`) gets a link in the folder.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


def socket_folders() -> tuple[Path, ...]:
    """The user's runtime folder, if it exists, and the private folder under /tmp; new sockets go to the first.

    Both are searched: a runtime that was started by cron or over ssh may not know the first.
    """
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    private = Path(f"/tmp/armwright-{os.getuid()}")
    return (Path(runtime) / "armwright", private) if runtime else (private,)


def default_path(arm_name: str) -> Path:
    """Default socket path of an arm's runtime."""
    return socket_folders()[0] / f"{arm_name}.sock"


def find_sockets(arm_name: str = "*") -> list[Path]:
    """All sockets of this user, or those of one arm; some may be left over from a killed runtime."""
    names = (f"{arm_name}.sock", f"{arm_name}--*.sock")
    found = [path for folder in socket_folders() for name in names for path in sorted(folder.glob(name))]
    return list(dict.fromkeys(path.resolve() for path in found if path.is_socket()))


@contextlib.contextmanager
def linked(path: Path, arm_name: str) -> Iterator[None]:
    """Let `find_sockets` find a socket at another path, within this context."""
    folder = socket_folders()[0]
    link = folder / f"{arm_name}--{os.getpid()}.sock"
    is_linked = False
    if path.absolute().parent != folder:
        with contextlib.suppress(OSError):  # the link is not essential
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            link.unlink(missing_ok=True)
            link.symlink_to(path.absolute())
            is_linked = True
    try:
        yield
    finally:
        if is_linked:
            link.unlink(missing_ok=True)
