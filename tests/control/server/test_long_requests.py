"""Requests with thousands of knots: read a slice a cycle, to the same as at once, while stops and others are served."""

from __future__ import annotations

import contextlib
import json
import random
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from control.errors import ArmError
from control.motion.joint_path import JointPath
from control.server import messages, server
from control.server.messages import Asked, asked
from control.server.server import Server, SLICE_bytes, is_long, steps

KNOTS = 4000


def joint_path(knots: int = KNOTS) -> dict[str, Any]:
    numbers = random.Random(5)
    rows = [[[numbers.uniform(-1.0, 1.0) for _ in range(3)] for _ in range(knots)] for _ in range(3)]
    for ends in rows[1:]:
        ends[0] = ends[-1] = [0.0] * 3
    times_s = [0.025 * k for k in range(knots)]
    return dict(zip(("times_s", "q_rad", "speed_rad_s", "acceleration_rad_s2"), (times_s, *rows), strict=True))


def line_of(do: str, **keys: Any) -> bytes:
    return json.dumps({"do": do, **keys}).encode()


def read(request: Asked) -> Any:
    reading = steps(request)
    while True:
        try:
            next(reading)
        except StopIteration as done:
            return done.value


def test_a_path_of_the_joints_is_read_to_the_same_as_at_once() -> None:
    message = joint_path()
    line = line_of("run_joints", path=message, detached=True, tool="")
    assert is_long(line)
    found, whole = read(asked(line)), JointPath.from_message(message)
    assert (found.detached, found.tool) == (True, "")
    assert found.path.times_s == whole.times_s
    assert found.path.knots == whole.knots


def test_paths_of_several_arms_are_read_to_the_same_as_at_once() -> None:
    moves = {"a": {"path": joint_path(2000)}, "b": {"q_rad": [0.0, 1.0, 2.0]}, "c": {"path": joint_path(300)}}
    found = read(asked(line_of("move_together", moves=moves))).moves
    assert found["a"].request(False).path.times_s == tuple(moves["a"]["path"]["times_s"])
    assert isinstance(found["a"].request(False), messages.RunJoints)
    assert found["b"].request(False) == messages.MoveJoints(q_rad=(0.0, 1.0, 2.0))
    assert found["c"].request(True).detached


def test_between_two_cycles_no_more_is_read_than_a_slice(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bytes of numbers that are decoded, however long the line is: to a row more than a slice."""
    decoded: list[int] = []

    class Counting:
        def __init__(self, decoder: msgspec.json.Decoder[Any]) -> None:
            self.decoder = decoder

        def decode(self, text: bytes) -> Any:
            decoded[-1] += len(text)
            return self.decoder.decode(text)

    for name in ("_ROWS", "_NUMBERS"):
        monkeypatch.setattr(server, name, Counting(getattr(server, name)))
    line = line_of("run_joints", path=joint_path())
    reading = steps(asked(line))
    decoded.append(0)
    with contextlib.suppress(StopIteration):
        while True:
            next(reading)
            decoded.append(0)
    assert max(decoded) <= SLICE_bytes + 100
    assert sum(decoded) > 0.95 * len(line) - 100
    assert len(decoded) > len(line) / SLICE_bytes


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"q_rad": [[0.0] * 3] * 3000 + [[0.0] * 2] * 1000}, "all of the same length"),
        ({"q_rad": [[0.0] * 3] * 3000 + [[0.0] * 2] + [[0.0] * 3] * 999}, "all of the same length"),
        ({"q_rad": [[0.0] * 3] * 3999 + [["x"] * 3]}, "joint path message"),
        ({"q_rad": [[[0.0]] * 3] * 4000}, "lists of numbers"),
        ({"q_rad": [0.0] * 4000}, "joint path message"),
        ({"times_s": [[0.1]] * 4000}, "joint path message"),
        ({"q_rad": ["x" * 300] * 4000}, "lists of numbers, got .* of another kind"),
        ({"q_rad": "x" * 300_000}, "lists of numbers, got .* of another kind"),
        ({"q_rad": [None] * 4000}, "lists of numbers"),
        ({"q_rad": [[1e999] * 3] * 4000}, "lists of numbers|finite"),
    ],
)
def test_what_is_no_path_is_one_error(change: dict[str, Any], said: str) -> None:
    text = line_of("run_joints", path=joint_path() | change).replace(b"Infinity", b"1e999")
    with pytest.raises(ArmError, match=said):
        read(asked(text))


@pytest.mark.parametrize("seed", range(40))
def test_damage_anywhere_is_an_error_of_the_request_or_none(seed: int) -> None:
    pick = random.Random(seed)
    line = bytearray(line_of("run_joints", path=joint_path(1000)))
    at = pick.randrange(40, len(line))
    line[at : at + pick.randrange(3)] = bytes(pick.choice(b'[],"{}:0-e. x') for _ in range(pick.randrange(3)))
    with contextlib.suppress(ArmError):
        read(asked(bytes(line)))


class Bench:
    """A server and its clients. `polls` of a long line are one for each slice, and some."""

    def __init__(self, path: Path) -> None:
        self.served: list[str] = []
        self.server = Server(path, self._serve, lambda client: None)
        self.clients = [self._client(), self._client()]
        self.server.poll()
        self.server.poll()

    def _serve(self, request: Asked, client: int) -> dict[str, Any]:
        self.served.append(request.do)
        return {"ok": True, "knots": len(request.read.path.times_s) if request.read is not None else 0}

    def _client(self) -> socket.socket:
        made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        made.connect(str(self.server.path))
        made.settimeout(30.0)
        return made

    def send_long(self, which: int = 0) -> None:
        """Send a long request, until the server has all of it and reads."""
        left = memoryview(line_of("run_joints", path=joint_path(2000), id=7) + b"\n")
        self.clients[which].setblocking(False)
        while left:
            try:
                left = left[self.clients[which].send(left) :]
            except BlockingIOError:
                self.server.poll()
        self.clients[which].settimeout(30.0)
        while self.server._under_way is None:
            self.server.poll()

    def answer(self, which: int) -> dict[str, Any]:
        for _ in range(200):
            self.server.poll()
        return dict(json.loads(self.clients[which].recv(1 << 16).partition(b"\n")[0]))


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path / "s")
    yield made
    for client in made.clients:
        client.close()
    made.server.close()


def test_a_long_request_is_served_with_its_path_read(bench: Bench) -> None:
    bench.send_long()
    assert bench.answer(0) == {"ok": True, "knots": 2000, "id": 7}


def test_others_are_served_meanwhile_and_what_its_client_sends_later_is_served_later(bench: Bench) -> None:
    bench.send_long()
    bench.clients[0].sendall(b'{"do": "mode"}\n')
    bench.clients[1].sendall(b'{"do": "status"}\n')
    bench.server.poll()
    assert bench.served == ["status"]
    bench.answer(0)
    assert bench.served == ["status", "run_joints", "mode"]


def test_a_stop_overtakes_it_and_it_is_refused(bench: Bench) -> None:
    bench.send_long()
    bench.clients[1].sendall(b'{"do": "stop"}\n')
    bench.server.poll()
    assert bench.served == ["stop"]
    assert "a stop came before it was served" in bench.answer(0)["error"]
    assert bench.served == ["stop"]


def test_of_a_client_that_is_gone_nothing_is_begun(bench: Bench) -> None:
    bench.send_long()
    bench.server._drop(bench.server.clients[0])
    for _ in range(100):
        bench.server.poll()
    assert bench.served == []
