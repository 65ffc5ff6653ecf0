"""The local socket against clients of all sorts: polled, one request a cycle, and nothing that a client does reaches the loop."""

from __future__ import annotations

import contextlib
import json
import os
import random
import socket
import stat
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import median
from typing import Any

import pytest

from control.errors import ArmError
from control.safety.modes import Mode
from control.server.channel import ForeignFolder, RuntimeGone, SocketChannel, find_sockets, foreign_folders, socket_folders
from control.server.messages import Asked
from control.server.server import (
    CLIENT_LIMIT,
    QUEUE_LIMIT,
    STOP_PLACES,
    CHUNK_bytes,
    Handle,
    LEAST_bytes,
    LINE_LIMIT_bytes,
    Server,
    SocketTaken,
    default_path,
    encoded,
)
from tests.cell import Cell


class Bench:
    """A server whose handler notes what it is asked, and plain sockets to it."""

    def __init__(self, path: Path, serve: Handle | None = None, on_gone: Callable[[int], None] | None = None) -> None:
        self.asked: list[tuple[dict[str, Any], int]] = []
        self.gone: list[int] = []
        self.handle: Callable[[dict[str, Any]], dict[str, Any]] = lambda request: {"ok": True, "do": request.get("do")}
        self.server = Server(path, serve or self.serve, on_gone or self.gone.append)
        self.sockets: list[socket.socket] = []

    def serve(self, asked: Asked, client: int) -> dict[str, Any]:
        request = json.loads(asked.line)
        self.asked.append((request, client))
        return self.handle(request)

    def client(self) -> socket.socket:
        first = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        first.settimeout(30.0)
        first.connect(str(self.server.path))
        self.sockets.append(first)
        return first

    def poll(self, times: int = 3) -> None:
        for _ in range(times):
            self.server.poll()

    def answer(self, one: socket.socket) -> dict[str, Any]:
        """The next answer, after as many cycles as it takes."""
        self.poll()
        received = b""
        while not received.endswith(b"\n"):
            received += one.recv(1 << 20)
        answer: dict[str, Any] = json.loads(received.splitlines()[0])
        return answer

    def close(self) -> None:
        for one in self.sockets:
            one.close()
        self.server.close()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path / "arm.sock")
    yield made
    made.close()


def is_alive(bench: Bench) -> bool:
    """Whether a new client is served."""
    client = bench.client()
    client.sendall(b'{"do": "ping"}\n')
    return bench.answer(client) == {"ok": True, "do": "ping"}


def test_a_poll_without_anything_to_do_returns_at_once(bench: Bench) -> None:
    took_s = []
    for _ in range(100):
        begun_s = time.perf_counter()
        bench.poll(1)
        took_s.append(time.perf_counter() - begun_s)
    assert min(took_s) < 5e-4  # one that waits does so every time; a busy machine does not


def test_an_id_comes_back_with_its_answer(bench: Bench) -> None:
    client = bench.client()
    client.sendall(b'{"do": "a", "id": 7}\n')
    assert bench.answer(client)["id"] == 7
    client.sendall(b'{"do": "a", "id": "seven"}\n')
    assert bench.answer(client)["id"] == "seven"


GARBAGE = [
    b"\x00\xff\xfe\n",
    b"hello\n",
    b"{\n",
    b"[1, 2]\n",
    b"null\n",
    b"5\n",
    b'"do"\n',
    b'{"do": NaN}\n',
    b'{"do": 1e999}\n',
    b'{"do": "\xff"}\n',
    b'{"do": "a"} {"do": "b"}\n',
    b"[" * 100_000 + b"\n",
    b'{"a":' * 20_000 + b"\n",
    b"\r\r\r\n",
    b'{"id": 123456789012345678901234567890, "do": 5.5}\n',
    b'{"do": "\\ud800"}\n',
    b"GET / HTTP/1.1\r\n",
]


@pytest.mark.parametrize("garbage", GARBAGE, ids=lambda line: repr(line[:20]))
def test_garbage_is_answered_or_skipped_and_the_next_request_is_served(bench: Bench, garbage: bytes) -> None:
    client = bench.client()
    client.sendall(garbage)
    bench.poll(60)
    client.sendall(b'{"do": "after"}\n')
    bench.poll(10)
    lines = client.recv(1 << 20).splitlines()
    assert json.loads(lines[-1]) == {"ok": True, "do": "after"}
    assert all(json.loads(line)["ok"] is False for line in lines[:-1] if b"after" not in line and b"5.5" not in line)


def test_random_bytes_never_stop_the_server(bench: Bench) -> None:
    source = random.Random(7)
    for _ in range(30):
        client = bench.client()
        client.sendall(bytes(source.choices(b'{}[]":,\n\n\\ \x00\xffdo1e', k=source.randrange(1, 400))))
        bench.poll(5)
        client.close()
    bench.poll(200)
    assert is_alive(bench)


def test_a_line_without_end_is_cut_off_with_its_client(bench: Bench) -> None:
    client = bench.client()
    client.setblocking(False)
    sent = 0
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):
        while sent < 2 * LINE_LIMIT_bytes:
            with contextlib.suppress(BlockingIOError):
                sent += client.send(b"x" * 4096)
            bench.poll(1)
    assert LINE_LIMIT_bytes <= sent < 2 * LINE_LIMIT_bytes
    assert is_alive(bench)


def test_a_request_may_come_in_pieces(bench: Bench) -> None:
    client = bench.client()
    for byte in b'{"do": "slow"}\n':
        client.sendall(bytes([byte]))
        bench.poll(1)
    assert bench.answer(client)["do"] == "slow"


def test_half_a_line_is_no_request(bench: Bench) -> None:
    client = bench.client()
    client.sendall(b'{"do": "half"}')
    bench.poll()
    client.close()
    bench.poll()
    assert bench.asked == []
    assert bench.gone == [1]


def test_a_client_that_floods_is_served_one_request_a_cycle_and_the_others_take_turns(bench: Bench) -> None:
    flood, other = bench.client(), bench.client()
    flood.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        for _ in range(10_000):
            flood.sendall(b'{"do": "flood"}\n' * 100)
    bench.poll(5)
    other.sendall(b'{"do": "other"}\n')
    served = len(bench.asked)
    bench.poll(4)
    assert len(bench.asked) == served + 4
    assert "other" in [request["do"] for request, _ in bench.asked[served:]]
    waiting = max(len(client.lines) for client in bench.server.clients)
    assert waiting < QUEUE_LIMIT + CHUNK_bytes // 16 + 1


def test_what_a_flood_costs_a_cycle_is_bounded(bench: Bench) -> None:
    flood = bench.client()
    flood.setblocking(False)
    took_s = []
    for _ in range(60):
        with contextlib.suppress(BlockingIOError):
            for _ in range(64):
                flood.send(b"\n" * 8192)
        begun_s = time.process_time()  # of this process alone
        bench.poll(1)
        took_s.append(time.process_time() - begun_s)
    assert median(took_s) < 2e-3  # each meets a full socket; the median, as other programs empty the caches at times


def test_all_clients_together_take_no_more_of_a_cycle_than_one_and_a_stop_among_them_is_heard_at_once(bench: Bench) -> None:
    crowd = [bench.client() for _ in range(CLIENT_LIMIT)]
    bench.poll(CLIENT_LIMIT)
    for one in crowd:
        one.sendall(b"x" * CHUNK_bytes)
    stopping = bench.client()
    bench.poll(1)
    before = sum(len(client.partial) for client in bench.server.clients)
    stopping.sendall(b'{"do": "stop"}\n')
    bench.poll(1)
    assert bench.asked == [({"do": "stop"}, CLIENT_LIMIT + 1)]
    taken = sum(len(client.partial) for client in bench.server.clients) - before
    assert 0 < taken <= CHUNK_bytes + LEAST_bytes


def test_a_line_that_grows_costs_a_cycle_what_came_in_it_however_long_it_is_already(bench: Bench) -> None:
    crowd = [bench.client() for _ in range(CLIENT_LIMIT)]
    bench.poll(CLIENT_LIMIT)
    for client in bench.server.clients:
        client.partial += b"x" * (LINE_LIMIT_bytes - CHUNK_bytes)
    took_s = []
    for _ in range(20):
        for one in crowd:
            one.sendall(b"x")
        begun_s = time.process_time()
        bench.poll(1)
        took_s.append(time.process_time() - begun_s)
    assert median(took_s) < 2e-3


def test_a_client_waits_for_its_turn_where_others_connect_all_the_time(tmp_path: Path) -> None:
    """Who connects with a crowd before the door is served after it, not turned away."""
    bench = Bench(tmp_path / "arm.sock")
    with contextlib.suppress(BlockingIOError):
        while True:
            first = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            bench.sockets.append(first)
            first.setblocking(False)
            first.connect(str(bench.server.path))
    with ThreadPoolExecutor() as pool:
        late = pool.submit(SocketChannel, bench.server.path, 30.0)
        while not late.done():
            bench.poll(1)
        late.result().close()
    bench.close()


def test_a_client_that_does_not_read_is_cut_off_and_nobody_waits_for_it(bench: Bench) -> None:
    bench.handle = lambda request: {"ok": True, "much": "x" * 50_000}
    deaf = bench.client()
    deaf.sendall(b'{"do": "talk"}\n' * 60)
    bench.poll(60)
    assert bench.gone == [1]
    bench.handle = lambda request: {"ok": True, "do": request["do"]}
    assert is_alive(bench)


def test_a_client_that_closes_its_sending_side_as_nc_does_gets_its_answer(bench: Bench) -> None:
    client = bench.client()
    client.sendall(b'{"do": "status"}\n')
    client.shutdown(socket.SHUT_WR)
    assert bench.answer(client) == {"ok": True, "do": "status"}
    assert client.recv(100) == b""
    assert bench.gone == [1]


def test_a_client_that_closes_its_sending_side_gets_all_its_answers(bench: Bench) -> None:
    client = bench.client()
    client.sendall(b'{"do": "a"}\n{"do": "b"}\n{"do": "c"}\n')
    client.shutdown(socket.SHUT_WR)
    bench.poll(6)
    assert [json.loads(line)["do"] for line in client.recv(1000).splitlines()] == ["a", "b", "c"]


def test_two_clients_are_two_numbers_and_each_gets_its_own_answer(bench: Bench) -> None:
    first, second = bench.client(), bench.client()
    second.sendall(b'{"do": "second"}\n')
    assert bench.answer(second)["do"] == "second"
    first.sendall(b'{"do": "first"}\n')
    assert bench.answer(first)["do"] == "first"
    assert [client for _, client in bench.asked] == [2, 1]
    first.close()
    bench.poll()
    assert bench.gone == [1]


def test_hundreds_of_connections_do_not_exhaust_the_loops_files(bench: Bench) -> None:
    crowd = []
    for _ in range(300):
        with contextlib.suppress(OSError):
            crowd.append(bench.client())
        bench.poll(1)
    assert len(bench.server.clients) <= CLIENT_LIMIT + STOP_PLACES
    for one in crowd:
        one.close()
    bench.poll(50)
    assert is_alive(bench)


def test_a_second_runtime_on_the_same_socket_is_refused(bench: Bench) -> None:
    with pytest.raises(SocketTaken, match=r"already serves at .*arm.sock"):
        Server(bench.server.path, bench.serve, bench.gone.append)
    assert is_alive(bench)


def test_the_socket_that_a_dead_runtime_left_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "arm.sock"
    dead = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    dead.bind(str(path))
    dead.close()
    made = Bench(path)
    assert is_alive(made)
    made.close()
    assert not path.exists()


def test_a_file_that_is_no_socket_is_never_removed(tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    path.write_text("name = 'mine'")
    with pytest.raises(SocketTaken, match="is not a socket"):
        Bench(path)
    assert path.read_text() == "name = 'mine'"


def test_a_path_that_no_socket_can_have_is_said_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(SocketTaken, match="cannot listen at"):
        Bench(tmp_path / ("x" * 200))


def test_only_the_user_who_started_the_runtime_can_open_its_socket(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    assert stat.S_IMODE(bench.server.path.stat().st_mode) == 0o600
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.delenv("ARMWRIGHT_RUNTIME_DIR", raising=False)
    assert default_path("right") == Path(f"/tmp/armwright-{os.getuid()}/right.sock")
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/5")
    assert default_path("right") == Path("/run/user/5/armwright/right.sock")
    monkeypatch.setenv("ARMWRIGHT_RUNTIME_DIR", "/srv/arms")
    assert socket_folders() == (Path("/srv/arms"),)


# ---- a stop has a place of its own


def test_a_stop_overtakes_what_waits_and_commands_before_it_are_refused(bench: Bench) -> None:
    flood, other = bench.client(), bench.client()
    flood.sendall(b'{"do": "move", "id": 1}\n' * 40)
    bench.poll(2)
    other.sendall(b'{"do": "move", "id": 2}\n{"do": "stop", "id": 3}\n{"do": "move", "id": 4}\n')
    bench.poll(1)
    assert [request["do"] for request, _ in bench.asked].count("stop") == 1
    bench.poll(60)
    begun = [request["id"] for request, _ in bench.asked if request["do"] == "move"]
    assert 2 not in begun
    assert begun[-1] == 4  # it came after the stop
    assert begun.count(1) <= 2
    answers = {answer["id"]: answer for answer in map(json.loads, other.recv(1 << 16).splitlines())}
    assert answers[3]["ok"]
    assert "a stop came before it was served" in answers[2]["error"]


def test_a_stop_is_served_however_many_idle_clients_there_are(bench: Bench) -> None:
    for _ in range(CLIENT_LIMIT + 3 * STOP_PLACES):
        bench.client()
        bench.poll(1)
    late = bench.client()
    late.sendall(b'{"do": "move"}\n')
    assert f"{CLIENT_LIMIT} clients are connected" in bench.answer(late)["error"]
    late.sendall(b'{"do": "status"}\n')
    assert bench.answer(late)["ok"]
    late.sendall(b'{"do": "stop"}\n')
    assert bench.answer(late)["ok"]
    assert len(bench.server.clients) <= CLIENT_LIMIT + STOP_PLACES


# ---- whose socket it is


def test_a_folder_of_somebody_else_is_used_by_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another user made the predictable folder in /tmp first."""
    folder = tmp_path / "armwright"
    folder.mkdir(mode=0o700)
    monkeypatch.setenv("ARMWRIGHT_RUNTIME_DIR", str(tmp_path / "armwright"))
    Bench(folder / "arm.sock").close()
    first = socket.socket(socket.AF_UNIX)
    first.bind(str(folder / "right.sock"))
    assert folder / "right.sock" in find_sockets("right")
    for spoil in (lambda: folder.chmod(0o777), lambda: monkeypatch.setattr(os, "getuid", lambda: 12345)):
        spoil()
        with pytest.raises(ForeignFolder, match="not used for sockets"):
            Bench(folder / "arm.sock")
        assert folder / "right.sock" not in find_sockets("right")
        assert str(folder) in str(foreign_folders()[0])
        folder.chmod(0o700)
    first.close()


def test_a_folder_that_is_a_link_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    (tmp_path / "armwright").symlink_to(tmp_path / "elsewhere")
    monkeypatch.setenv("ARMWRIGHT_RUNTIME_DIR", str(tmp_path / "armwright"))
    with pytest.raises(ForeignFolder, match="a link or a file"):
        Bench(tmp_path / "armwright" / "arm.sock")


def test_a_socket_in_a_folder_that_everybody_may_write_to_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o777)
    with pytest.raises(ForeignFolder, match="others may write to it"):
        Bench(tmp_path / "arm.sock")
    tmp_path.chmod(0o1777)  # as /tmp: nobody removes another one's file
    Bench(tmp_path / "arm.sock").close()


def test_a_client_sends_nothing_to_the_runtime_of_another_user(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    with pytest.raises(RuntimeGone, match="runs as user"):
        SocketChannel(bench.server.path)
    bench.poll()
    assert bench.asked == []


# ---- with a runtime behind it


@pytest.fixture
def served(cell: Cell, tmp_path: Path) -> Iterator[Bench]:
    """The runtime of a stepped cell behind a real socket; `poll` runs a cycle, then the server, as the loop does."""
    requests = cell.assembly.requests
    made = Bench(tmp_path / "right.sock", requests.handle, requests.on_gone)

    def poll(times: int = 3) -> None:
        for _ in range(times):
            cell.run(0.002)
            made.server.poll()

    made.poll = poll  # type: ignore[method-assign]
    yield made
    made.close()


def test_no_line_ends_the_runtime(served: Bench, cell: Cell) -> None:
    """6 kB of nested lists as `id` were decoded, and failed when they were encoded again."""
    arm = served.client()
    for text in (
        '{"do": "status", "id": %s}',
        '{"do": "move_joints", "q_rad": %s}',
        '{"do": %s}',
        '{"do": "run_path", "path": %s}',
    ):
        for depth in (100, 990, 3000):
            arm.sendall((text % ("[" * depth + "]" * depth)).encode() + b"\n")
            served.poll(10)
            assert json.loads(arm.recv(1 << 20).splitlines()[-1])["ok"] is False
    assert cell.mode is Mode.HOLDING


def test_a_program_of_somebody_else_moves_the_arm_in_ten_lines(served: Bench, cell: Cell) -> None:
    arm = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    arm.connect(str(served.server.path))
    lines = arm.makefile("r")

    def ask(**request: Any) -> Any:
        arm.sendall(json.dumps(request).encode() + b"\n")
        served.poll()
        return json.loads(lines.readline())

    assert ask(do="status", id=1)["mode"] == "HOLDING"
    assert ask(do="move_joints", q_rad=[0.2, -0.5, 0.3], speed=0.8)["duration_s"] > 0.1
    while (state := ask(do="status"))["mode"] == "MOVING":
        served.poll(10)
    assert state["q_rad"] == pytest.approx([0.2, -0.5, 0.3], abs=2e-3)
    lines.close()
    arm.close()
    served.poll()


def test_a_connection_that_breaks_while_its_motion_runs_stops_the_arm(served: Bench, cell: Cell) -> None:
    client = served.client()
    client.sendall(b'{"do": "move_joints", "q_rad": [0.6, -0.3, 0.5]}\n')
    assert served.answer(client)["ok"]
    client.close()
    served.poll(3)
    assert cell.mode is Mode.STOPPING


def test_the_rows_before_a_fault_fit_into_one_answer(served: Bench, cell: Cell) -> None:
    cell.run(0.6)
    cell.inject("lost_wire", "encoder", channel=0)
    cell.until_fault(0.02)
    client = served.client()
    client.sendall(b'{"do": "fault_cycles"}\n')
    assert served.answer(client)["ok"]


def test_a_runtime_that_is_not_there_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(RuntimeGone, match=r"no runtime answers at .*start one with `armwright serve`"):
        SocketChannel(tmp_path / "none.sock")


def test_an_answer_that_nobody_waited_for_is_not_taken_for_the_next_one(tmp_path: Path) -> None:
    """An operator's Ctrl-C falls between a request and its answer, and the next request is `hold`."""
    path = tmp_path / "runtime.sock"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        channel = SocketChannel(path)
        runtime, _ = listener.accept()
        with runtime:
            runtime.sendall(b'{"ok": true, "id": 0, "mode": "GUIDING"}\n{"ok": true, "id": 1, "mode": "HOLDING"}\n')
            assert channel.request({"do": "hold"})["mode"] == "HOLDING"
            assert json.loads(runtime.recv(1000)) == {"do": "hold", "id": 1}
            channel.close()


def test_a_file_name_that_is_no_text_ends_no_runtime() -> None:
    name = b"/log/by\xfcte".decode("ascii", "surrogateescape")
    assert json.loads(encoded({"recording": name, "t_s": 1.5})) == {"recording": "/log/by\ufffdte", "t_s": 1.5}
    name = "/log/prüfung".encode().decode("ascii", "surrogateescape")  # of a process with LC_ALL=C
    assert json.loads(encoded({"recording": name})) == {"recording": "/log/prüfung"}


@pytest.mark.parametrize("name", ["../../..", "", "a/b", ".", "x" * 65, "a\nb"])
def test_an_arm_s_name_leads_to_no_other_folder(name: str) -> None:
    with pytest.raises(ArmError, match="sockets and recordings are named after the arm"):
        default_path(name)
    assert find_sockets(name) == []


def test_an_arm_that_does_not_run_is_answered_with_those_that_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ARMWRIGHT_RUNTIME_DIR", str(tmp_path / "armwright"))
    folder = tmp_path / "armwright"
    folder.mkdir(mode=0o700)
    left_over, listens = (socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) for _ in range(2))
    with left_over, listens:
        left_over.bind(str(folder / "gone.sock"))  # a killed runtime's
        listens.bind(str(folder / "fee5.sock"))
        listens.listen()
        with pytest.raises(RuntimeGone, match=r"start one with `armwright serve`, or ask the one that runs: `--arm fee5`$"):
            SocketChannel(folder / "right.sock")
