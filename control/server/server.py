"""The local socket of the loop: polled between cycles, never blocking.

Newline-separated JSON over a Unix socket that only this user can open. At most one request is served a cycle, and a slice of one
long one is read (control.server.server), whatever clients send; a client that stops reading is disconnected. What a
connection began ends with it, for whatever reason it closes (a lost terminal must not leave a moving arm).

A stop has a place of its own: it is served before everything that waits, commands that came before it are refused, and
beyond the usual number of connections there are places in which only stopping and watching are served.
"""

import contextlib
import json
import os
import selectors
import socket
import stat
from collections.abc import Callable, Generator, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from control.errors import ArmError
from control.files import utf_8
from control.motion.joint_path import JointPath
from control.server import messages
from control.server.channel import ForeignFolder, peer_uid, require_private, socket_folders
from control.server.channel import default_path as default_path
from control.server.messages import LONG, STOPPING, WATCHING, Asked, asked, is_at_once

Message = dict[str, Any]
Handle = Callable[[Asked, int], Message]
LINE_LIMIT_bytes = 1 << 20  # a path of thousands of way-points fits
QUEUE_LIMIT = 64  # requests of one client that may wait; beyond that its bytes stay in the kernel and slow it down
CHUNK_bytes = 1 << 13  # taken from all clients a cycle: even newlines alone are split well within a cycle
LEAST_bytes = 1 << 8  # of one of them: a stop fits, so it is heard in the cycle in which it comes
CLIENT_LIMIT = 32  # connections at a time; more would use up the loop's file descriptors
STOP_PLACES = 4  # beyond them; the oldest makes room for the next


def encoded(message: Message) -> bytes:
    """Encode as JSON in UTF-8; undecodable bytes of file names become U+FFFD."""
    try:
        return msgspec.json.encode(message)
    except UnicodeEncodeError:
        return utf_8(json.dumps(message, ensure_ascii=False))


class SocketTaken(ArmError):
    """The socket path is in use by another runtime, or by a file that is not a socket."""


class WaitingRequest(NamedTuple):
    """A request that waits, and how many stops the server had seen when it came."""

    content: bytes
    stops: int


class UnderWay(NamedTuple):
    """A long request that is being read."""

    client: "Client"
    answering: Generator[None, None, Message]


class ListeningSocket(NamedTuple):
    """A socket that accepts connections, and the arm that they are for; empty where one arm is served."""

    arm: str
    path: Path
    socket: socket.socket


class Client:
    """One connection: received bytes, and pending requests. `may_command`: not in a place for stops only. `arm`: to whose
    socket it came; empty where one arm is served.
    """

    def __init__(self, connection: socket.socket, number: int, may_command: bool, arm: str) -> None:
        self.connection = connection
        self.number = number
        self.arm = arm
        self.may_command = may_command
        self.partial = bytearray()  # grows in place: a long line costs a cycle what came in it
        self.lines: list[WaitingRequest] = []
        self.is_over = False

    def receive(self, stops: int, most_bytes: int) -> bytes | None:
        """Receive pending bytes and return the first stop among them; sets `is_over` at the end of the connection."""
        if len(self.lines) >= QUEUE_LIMIT:
            return None
        try:
            chunk = self.connection.recv(most_bytes)
        except BlockingIOError:
            return None
        except OSError:
            chunk = b""
        *lines, rest = chunk.split(b"\n")
        if lines:
            lines[0] = bytes(self.partial) + lines[0]
            self.partial.clear()
        self.partial += rest
        self.is_over = not chunk or len(self.partial) > LINE_LIMIT_bytes
        urgent: bytes | None = None
        for line in [line for line in lines if line.strip()]:
            if urgent is None and is_at_once(line):
                urgent = line
                stops += 1
            else:
                self.lines.append(WaitingRequest(line, stops))
        return urgent


class Server:
    """Serves `handle(request, client_number) -> answer`; `on_gone(client_number)` is called when a client disconnects.

    `path`: of the socket; or one for each arm of a cell, by its name, which requests are about unless they say otherwise.
    """

    def __init__(self, path: Path | Mapping[str, Path], handle: Handle, on_gone: Callable[[int], None]) -> None:
        paths = {"": path} if isinstance(path, Path) else dict(path)
        self.path = next(iter(paths.values()))
        self._handle = handle
        self._on_gone = on_gone
        self._clients: list[Client] = []
        self._turn = 0
        self._numbers = 0
        self._stops = 0
        self._under_way: UnderWay | None = None
        for socket_path in paths.values():
            require_free(socket_path)
        self._listeners = [ListeningSocket(arm, socket_path, listen(socket_path)) for arm, socket_path in paths.items()]
        self._selector = selectors.DefaultSelector()
        for listener in self._listeners:
            self._selector.register(listener.socket, selectors.EVENT_READ, listener)

    def poll(self) -> None:
        """Accept, receive and serve all stops, or else at most one request and a slice of a long one; returns at once."""
        stopped = False
        ready = self._selector.select(0)
        share = max(CHUNK_bytes // max(len(ready), 1), LEAST_bytes)
        for key, _ in ready:
            client = key.data
            if isinstance(client, ListeningSocket):
                self._accept(client)
                continue
            if (line := client.receive(self._stops, share)) is not None:
                self._stops += 1
                stopped = True
                self._serve(client, WaitingRequest(line, self._stops))
        if not stopped:
            self._read_on()
            self._serve_one()
        reading = None if self._under_way is None else self._under_way.client
        for client in [c for c in self._clients if c.is_over and not c.lines and c is not reading]:
            self._drop(client)

    @property
    def clients(self) -> tuple[Client, ...]:
        """The open connections."""
        return tuple(self._clients)

    def close(self) -> None:
        """Close every connection and remove the socket."""
        for client in list(self._clients):
            self._drop(client)
        self._selector.close()
        for listener in self._listeners:
            listener.socket.close()
            listener.path.unlink(missing_ok=True)

    def _accept(self, listener: ListeningSocket) -> None:
        try:
            connection, _ = listener.socket.accept()
        except OSError:  # the client has disconnected, or no file descriptors are left
            return
        if peer_uid(connection) not in (os.getuid(), 0):
            connection.close()
            return
        may_command = sum(client.may_command for client in self._clients) < CLIENT_LIMIT
        if not may_command:
            others = [client for client in self._clients if not client.may_command]
            if len(others) >= STOP_PLACES:
                self._drop(others[0])
        connection.setblocking(False)
        self._numbers += 1
        client = Client(connection, self._numbers, may_command, listener.arm)
        self._clients.append(client)
        self._selector.register(connection, selectors.EVENT_READ, client)

    def _serve_one(self) -> None:
        waiting = [client for client in self._clients if client.lines and self._may_be_served(client)]
        if not waiting:
            return
        self._turn += 1
        client = waiting[self._turn % len(waiting)]
        self._serve(client, client.lines.pop(0))

    def _may_be_served(self, client: Client) -> bool:
        """Requests of a client are served in their order, and one long one at a time."""
        under_way = self._under_way
        return under_way is None or not (client is under_way.client or is_long(client.lines[0].content))

    def _serve(self, client: Client, line: WaitingRequest) -> None:
        under_way = UnderWay(client, self._answering(line, client))
        if not self._goes_on(under_way):
            self._under_way = under_way

    def _read_on(self) -> None:
        if (under_way := self._under_way) is not None and self._goes_on(under_way):
            self._under_way = None

    def _goes_on(self, under_way: UnderWay) -> bool:
        """Whether a request has been answered by its next step."""
        try:
            next(under_way.answering)
            return False
        except StopIteration as done:
            answer: Message = done.value
        try:
            under_way.client.connection.sendall(encoded(answer) + b"\n")
        except OSError:
            self._drop(under_way.client)
        return True

    def _answering(self, line: WaitingRequest, client: Client) -> Generator[None, None, Message]:
        try:
            request = asked(line.content)
        except ArmError as error:
            return {"ok": False, "error": str(error)}
        error_of_path = ""
        if request.do in LONG and is_long(line.content):
            yield
            try:
                request = request._replace(read=(yield from steps(request)))
            except ArmError as error:
                error_of_path = str(error)
        answer = {"ok": False, "error": error_of_path} if error_of_path else self._answer(request, line, client)
        if request.id is not None:
            answer["id"] = request.id
        return answer

    def _answer(self, request: Asked, line: WaitingRequest, client: Client) -> Message:
        if not request.arm:
            request = request._replace(arm=client.arm)
        is_command = request.do not in STOPPING | WATCHING
        if is_command and line.stops != self._stops:
            answer: Message = {"ok": False, "error": f"request {request.do!r}: a stop came before it was served"}
        elif is_command and not client.may_command:
            crowd = f"{CLIENT_LIMIT} clients are connected: close some of them (this connection may watch and stop)"
            answer = {"ok": False, "error": f"request {request.do!r}: {crowd}"}
        else:
            answer = self._handle(request, client.number)
        return answer

    def _drop(self, client: Client) -> None:
        if client not in self._clients:
            return
        self._clients.remove(client)
        if self._under_way is not None and self._under_way.client is client:
            self._under_way = None
        self._selector.unregister(client.connection)
        client.connection.close()
        self._on_gone(client.number)


def listen(path: Path) -> socket.socket:
    """Create a listening socket at `path`, for this user only. SocketTaken says why it failed."""
    require_free(path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        with _umask(0o077):
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        _require_safe(path.parent)
        path.unlink(missing_ok=True)
        with _umask(0o177):  # nobody else can open it, at no time
            listener.bind(str(path))
    except OSError as error:
        listener.close()
        raise SocketTaken(f"cannot listen at {path}: {error}; choose another path with --socket") from error
    except ArmError:
        listener.close()
        raise
    listener.listen(CLIENT_LIMIT)
    listener.setblocking(False)
    return listener


@contextlib.contextmanager
def _umask(mask: int) -> Iterator[None]:
    before = os.umask(mask)
    try:
        yield
    finally:
        os.umask(before)


def _require_safe(folder: Path) -> None:
    """ForeignFolder if others could put another socket into the folder."""
    if folder in socket_folders():
        require_private(folder)
        return
    mode = folder.stat().st_mode
    if mode & (stat.S_IWGRP | stat.S_IWOTH) and not mode & stat.S_ISVTX:
        raise ForeignFolder(
            f"{folder}: others may write to it (mode {stat.S_IMODE(mode):o}), and could receive a stop in place of the"
            " runtime: choose another path with --socket"
        )


def require_free(path: Path) -> None:
    """Raise SocketTaken if a runtime answers at `path`, or if it is not a socket."""
    if not path.exists():
        return
    if not path.is_socket():
        raise SocketTaken(f"{path} is not a socket and is not replaced: choose another path with --socket")
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)) as probe:
        if probe.connect_ex(str(path)) == 0:
            raise SocketTaken(
                f"a runtime already serves at {path}: use it, or stop it with `armwright off --quit --socket {path}`"
            )


# Long requests, read a slice at a time: thousands of knots are a megabyte of text, which at once would cost some cycles.
#
#     outline   one pass over the line finds where the texts of its lists begin and end
#     slices    of such a text: as many rows of numbers as SLICE_bytes hold, into an array
#     path      of the arrays, checked as far as that needs nothing of the arm's state
#
# Between two steps the loop runs a cycle. A slice takes some 0.3 ms; for 10,000 knots the pass over the line and the making of
# the path, one step each, take some 2 ms.

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

LONG_bytes: Final = 1 << 14  # of a line that is read in slices
SLICE_bytes: Final = 1 << 14
WORDS_bytes: Final = 1 << 17  # of a list with words in it: what slows two thousand sections
Steps = Generator[None, None, Any]
_OBJECT: Final = msgspec.json.Decoder(dict[str, msgspec.Raw])
_ROWS: Final = msgspec.json.Decoder(list[list[float]])
_NUMBERS: Final = msgspec.json.Decoder(list[float])


def is_long(line: bytes) -> bool:
    """Whether a line is read in slices."""
    return len(line) > LONG_bytes


def steps(request: Asked) -> Steps:
    """Read a request, and return what `messages.decoded` does, its paths made. ArmError at any step."""
    outline = messages.outlined(request)
    yield
    moves = outline.moves.values() if isinstance(outline, messages.MoveTogether) else (outline,)
    for move in moves:
        if isinstance(move.path, dict):
            path: dict[str, Any] = {}
            for name, text in move.path.items():
                path[name] = yield from _value(text)
            move.path = JointPath.from_message(path)
            yield
    return outline


def _value(raw: msgspec.Raw) -> Steps:
    text = bytes(raw).strip()
    try:
        if text[:1] == b"{":
            members: dict[str, Any] = {}
            for name, inner in _OBJECT.decode(text).items():
                members[name] = yield from _value(inner)
            return members
        if text[:1] == b"[" and len(text) > SLICE_bytes and b'"' not in text:
            return (yield from _numbers(text[1:-1].strip()))
        if len(text) > WORDS_bytes:
            raise ArmError(f"path: expected lists of numbers, got {len(text)} bytes of another kind")
        return msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ArmError(f"path: expected lists of numbers, all of the same length ({error})") from None


def _numbers(text: bytes) -> Generator[None, None, "NDArray[np.float64]"]:
    """A list of numbers, or of rows of them, whose brackets are left out."""
    import numpy as np

    decoder, end = (_ROWS, b"]") if text[:1] == b"[" else (_NUMBERS, b"")
    arrays, at = [], 0
    while at < len(text):
        until = text.find(end + b",", at + SLICE_bytes)
        until = len(text) if until < 0 else until + len(end)
        try:
            arrays.append(np.array(decoder.decode(b"[%b]" % text[at:until]), dtype=np.float64))
        except msgspec.DecodeError:  # a ValueError, too
            raise
        except ValueError:  # rows that are not equally long
            raise ArmError("path: expected rows of numbers, all of the same length") from None
        at = until + 1
        yield
    if len({array.shape[1:] for array in arrays}) != 1:
        raise ArmError("path: expected rows of numbers, all of the same length")
    return np.concatenate(arrays)
