"""`armwright stop`: every runtime of this user, without a file that it could stumble over."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from console.main import main
from control.server import channel
from control.server.messages import Asked
from control.server.server import Server

Serve = Callable[[Path, str], list[str]]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two folders of this test's own, and a default arm that cannot be read."""
    folders = (tmp_path / "run", tmp_path / "private")
    for each in folders:
        each.mkdir()
    monkeypatch.setattr(channel, "socket_folders", lambda: folders)
    monkeypatch.setenv("ARMWRIGHT_ARM", "none.toml")
    return folders[0]


@pytest.fixture
def serve() -> Iterator[Serve]:
    """Starts runtimes that know only what a stop needs; each keeps what it was asked."""
    ended = threading.Event()
    threads = []

    def start(path: Path, name: str) -> list[str]:
        asked: list[str] = []

        def answer(request: Asked, client: int) -> dict[str, Any]:
            asked.append(request.do)
            return {"ok": True, "mode": "HOLDING", "arm": name, "was_stopped": True, "step": "", "pace": 1.0}

        server = Server(path, answer, lambda client: None)

        def run() -> None:
            while not ended.wait(0.001):
                server.poll()
            server.close()

        threads.append(threading.Thread(target=run))
        threads[-1].start()
        return asked

    yield start
    ended.set()
    for thread in threads:
        thread.join()


def test_every_runtime_of_the_user_is_stopped_with_a_line_each(
    folder: Path, serve: Serve, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = [serve(folder / "left.sock", "left"), serve(folder.parent / "private" / "right.sock", "right")]
    assert main(["stop"]) == 0
    assert [each[0] for each in asked] == ["stop", "stop"]
    out = capsys.readouterr().out
    assert out.count("\n") == 2
    assert "arm 'left'" in out
    assert "arm 'right'" in out


def test_with_an_arm_only_its_runtime_is_stopped(folder: Path, serve: Serve) -> None:
    left, right = serve(folder / "left.sock", "left"), serve(folder / "right.sock", "right")
    assert main(["stop", "--arm", "left"]) == 0
    assert left[0] == "stop"
    assert right == []


def test_an_arm_file_that_cannot_be_read_stops_all_and_says_why(
    folder: Path, serve: Serve, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = serve(folder / "right.sock", "right")
    broken = tmp_path / "arm.toml"
    broken.write_text("[[dh\n")
    assert main(["stop", "--arm", str(broken)]) == 0
    assert asked[0] == "stop"
    error = capsys.readouterr().err
    assert "arm.toml, line 1" in error
    assert "stopping every runtime of this user instead" in error


def test_a_runtime_that_listens_elsewhere_is_found_by_its_link(folder: Path, serve: Serve, tmp_path: Path) -> None:
    asked = serve(tmp_path / "elsewhere.sock", "right")
    with channel.linked(tmp_path / "elsewhere.sock", "right"):
        assert main(["stop"]) == 0
        assert main(["stop", "--arm", "right"]) == 0
    assert asked.count("stop") == 2
    assert list(folder.iterdir()) == []


def test_a_runtime_that_hangs_fails_the_stop_but_not_that_of_the_others(
    folder: Path, serve: Serve, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = serve(folder / "right.sock", "right")
    with socket.socket(socket.AF_UNIX) as hung:
        hung.bind(str(folder / "hung.sock"))
        hung.listen()
        assert main(["stop"]) == 1
    assert asked[0] == "stop"
    printed = capsys.readouterr()
    assert "right.sock: stopped, HOLDING" in printed.out
    assert "hung.sock does not answer" in printed.err


def test_a_socket_that_a_killed_runtime_left_is_no_runtime(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_UNIX) as left_over:
        left_over.bind(str(folder / "right.sock"))
    assert main(["stop"]) == 1
    assert "no runtime found" in capsys.readouterr().err
