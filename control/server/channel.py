"""How requests reach the runtime: one JSON object a line over its socket, or a runtime in the same process (tests, mocks)."""

import os
import socket
import struct
from pathlib import Path
from typing import Any, Protocol

import msgspec

from control.errors import ArmError
from control.server.sockets import ForeignRuntime, require_own_runtime, running_arms

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
