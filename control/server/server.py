"""The local socket of the loop: polled between cycles, never blocking.

Newline-separated JSON over a Unix socket that only this user can open. At most one request is served a cycle, whatever clients
send; a client that stops reading is disconnected. A motion belongs to the connection that started it: when that connection
closes, for whatever reason, the motion is stopped (a lost terminal must not leave a moving arm).
"""

import contextlib
import json
import selectors
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from control.errors import ArmError
from control.files import utf_8
from control.server.sockets import default_path as default_path

Message = dict[str, Any]
Handle = Callable[[Message, int], Message]
LINE_LIMIT_bytes = 1 << 20  # a path of thousands of way-points fits
QUEUE_LIMIT = (
    64  # requests of one client that may wait; beyond that its bytes stay in the kernel and slow it down
)
CHUNK_bytes = 1 << 13  # taken from one client a cycle: even newlines alone are split well within a cycle
CLIENT_LIMIT = 32  # connections at a time; more would use up the loop's file descriptors


def encoded(message: Message) -> bytes:
    """Encode as JSON in UTF-8; undecodable bytes of file names become U+FFFD."""
    try:
        return msgspec.json.encode(message)
    except UnicodeEncodeError:
        return utf_8(json.dumps(message, ensure_ascii=False))


class SocketTaken(ArmError):
    """The socket path is in use by another runtime, or by a file that is not a socket."""


class Client:
    """One connection: received bytes, and pending requests."""

    def __init__(self, connection: socket.socket, number: int) -> None:
        self.connection = connection
        self.number = number
        self.partial = b""
        self.lines: list[bytes] = []
        self.is_over = False

    def receive(self) -> None:
        """Receive pending bytes; sets `is_over` at the end of the connection."""
        if len(self.lines) >= QUEUE_LIMIT:
            return
        try:
            chunk = self.connection.recv(CHUNK_bytes)
        except BlockingIOError:
            return
        except OSError:
            chunk = b""
        *lines, self.partial = (self.partial + chunk).split(b"\n")
        self.lines += [line for line in lines if line.strip()]
        self.is_over = not chunk or len(self.partial) > LINE_LIMIT_bytes


class Server:
    """Serves `handle(request, client_number) -> answer`; `on_gone(client_number)` is called when a client disconnects."""

    def __init__(self, path: Path, handle: Handle, on_gone: Callable[[int], None]) -> None:
        self.path = path
        self._handle = handle
        self._on_gone = on_gone
        self._clients: list[Client] = []
        self._turn = 0
        self._numbers = 0
        self._listener = listen(path)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ, None)

    def poll(self) -> None:
        """Accept, receive and serve at most one request; returns at once."""
        for key, _ in self._selector.select(0):
            client = key.data
            if client is None:
                self._accept()
            else:
                client.receive()
        self._serve_one()
        for client in [c for c in self._clients if c.is_over and not c.lines]:
            self._drop(client)

    @property
    def clients(self) -> tuple[Client, ...]:
        """The number of open connections."""
        return tuple(self._clients)

    def close(self) -> None:
        """Close every connection and remove the socket."""
        for client in list(self._clients):
            self._drop(client)
        self._selector.close()
        self._listener.close()
        self.path.unlink(missing_ok=True)

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:  # the client has disconnected, or no file descriptors are left
            return
        if len(self._clients) >= CLIENT_LIMIT:
            connection.close()
            return
        connection.setblocking(False)
        self._numbers += 1
        client = Client(connection, self._numbers)
        self._clients.append(client)
        self._selector.register(connection, selectors.EVENT_READ, client)

    def _serve_one(self) -> None:
        waiting = [client for client in self._clients if client.lines]
        if not waiting:
            return
        self._turn += 1
        client = waiting[self._turn % len(waiting)]
        answer = self._answer(client.lines.pop(0), client.number)
        try:
            client.connection.sendall(encoded(answer) + b"\n")
        except OSError:
            self._drop(client)

    def _answer(self, line: bytes, number: int) -> Message:
        try:
            request = msgspec.json.decode(line)
        except (ValueError, RecursionError) as error:  # invalid JSON or UTF-8, or nested too deeply
            return {
                "ok": False,
                "error": f"request: expected one JSON object per line, got invalid JSON: {error}",
            }
        if not isinstance(request, dict):
            return {
                "ok": False,
                "error": f"request: expected a JSON object with the key `do`, got {line[:80]!r}",
            }
        answer = self._handle(request, number)
        if "id" in request:
            answer["id"] = request["id"]
        return answer

    def _drop(self, client: Client) -> None:
        if client not in self._clients:
            return
        self._clients.remove(client)
        self._selector.unregister(client.connection)
        client.connection.close()
        self._on_gone(client.number)


def listen(path: Path) -> socket.socket:
    """Create a listening socket at `path`, for this user only. SocketTaken says why it failed."""
    require_free(path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        listener.bind(str(path))
        path.chmod(0o600)
    except OSError as error:
        listener.close()
        raise SocketTaken(f"cannot listen at {path}: {error}; choose another path with --socket") from error
    listener.listen(8)
    listener.setblocking(False)
    return listener


def require_free(path: Path) -> None:
    """Raise SocketTaken if a runtime answers at `path`, or if it is not a socket."""
    if not path.exists():
        return
    if not path.is_socket():
        raise SocketTaken(f"{path} is not a socket and is not replaced: choose another path with --socket")
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)) as probe:
        if probe.connect_ex(str(path)) == 0:
            raise SocketTaken(
                f"a runtime already serves at {path}: use it, or stop it with `armwright off --quit`"
            )
