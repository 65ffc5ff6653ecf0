"""Ports and buses are commanded by one program of this machine at a time, whoever runs it.

Two programs that command the same boards contradict each other, and the arm ends in a fault in the middle of a motion. A tty can
be locked, a CAN interface cannot. So a program that opens a line as its host first binds a Unix socket to an abstract name made
of the line (unix(7)): the kernel gives a name to one socket only, whatever user asks, keeps it in no folder, and takes it back
with the process, however that ends. Such names belong to a network namespace, as CAN interfaces do.

A process may open a line more than once, as an arm with two kinds of boards on its bus does: its links share the claim.
"""

import contextlib
import errno
import os
import shlex
import socket
import stat
import struct
import weakref
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from firmware_iface.errors import PortInUse

SHOWN = 100  # characters of another program's command line
LONGEST_NAME_bytes = 90  # of the 107 that an address has; what differs is at the end
_ASKING = 1024  # programs that may ask who has a line, one after the other
_PEER = struct.Struct("3i")  # pid, uid, gid: struct ucred of unix(7)
_PTY_MAJORS = range(136, 144)
_REMOTE = ("socket", "rfc2217")
WITHIN_A_PROCESS: Final = frozenset({"virtual"})  # CAN interfaces


class Claim:
    """A line that is this process's. It ends when it is closed by all links that share it, or nobody refers to it any more."""

    def __init__(self, line: str, where: str) -> None:
        """PortInUse says which program has it; `where` is how messages call the line."""
        bound = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        address = b"\0armwright/" + os.fsencode(line)[-LONGEST_NAME_bytes:]
        try:
            bound.bind(address)
            bound.listen(_ASKING)
        except OSError as problem:
            bound.close()
            if problem.errno != errno.EADDRINUSE:
                raise PortInUse(f"{where}: cannot reserve it for this program: {problem.strerror}") from None
            raise PortInUse(
                f"{where}: in use by {_holder(address)}: ask that program, or end it (`armwright off --quit` ends a runtime)"
            ) from None
        weakref.finalize(self, os.close, bound.detach())


_CLAIMS: "weakref.WeakValueDictionary[str, Claim]" = weakref.WeakValueDictionary()


def claim_can(interface: str, channel: str, port: object = "") -> Claim | None:
    """Claim a CAN bus; None for one that lives within a process. `port`: of a bus over UDP. PortInUse."""
    if interface in WITHIN_A_PROCESS:
        return None
    return _claim(f"can/{interface}/{channel}/{port}", f"CAN bus {interface}:{channel}")


def claim_serial(url: str, device: str | None) -> Claim | None:
    """Claim a serial port: a `device`, whatever its name, or a server's; None for what lives within a process. PortInUse."""
    where = f"serial port {url}"
    if device is not None:
        try:
            status = Path(device).stat()
        except OSError:  # opening it says why
            return None
        if not stat.S_ISCHR(status.st_mode):
            return None
        # Ptys are numbered anew in each container.
        within = status.st_dev if os.major(status.st_rdev) in _PTY_MAJORS else 0
        return _claim(f"serial/{within}/{os.major(status.st_rdev)}:{os.minor(status.st_rdev)}", where)
    parts = urlsplit(url)
    if parts.scheme not in _REMOTE:
        return None
    address: object = parts.netloc
    with contextlib.suppress(OSError, ValueError):  # one address, whatever its names
        address = socket.getaddrinfo(parts.hostname, parts.port, type=socket.SOCK_STREAM)[0][4][:2]
    return _claim(f"serial/{address}", where)


def _claim(line: str, where: str) -> Claim:
    claim = _CLAIMS.get(line)
    if claim is None:
        claim = _CLAIMS[line] = Claim(line, where)
    return claim


def _holder(address: bytes) -> str:
    """The program that has bound an address, as the kernel knows it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)
        try:
            asking.connect(address)
            pid, uid, _ = _PEER.unpack(asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))
        except OSError:
            return "another program"
    user = "" if uid == os.getuid() else f" of user {uid}"
    return f"process {pid}{user}{_command_line(pid)}"


def _command_line(pid: int) -> str:
    """What a process was started with, in brackets; empty if the system does not tell."""
    try:
        words = [os.fsdecode(word) for word in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0") if word]
    except OSError:
        return ""
    named = [k for k, word in enumerate(words) if Path(word).name == "armwright"]
    if named:  # not the interpreter's path
        words = ["armwright", *words[named[0] + 1 :]]
    text = "".join(letter if letter.isprintable() else "?" for letter in shlex.join(words))
    return f" ({text if len(text) <= SHOWN else text[:SHOWN] + '...'})" if text else ""
