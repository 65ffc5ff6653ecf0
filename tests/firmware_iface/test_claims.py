"""A port or bus is one program's at a time: whoever runs it, however the line is named, and however the program ends."""

from __future__ import annotations

import os
import pty
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from firmware_iface.can_link import join_can, open_can, open_fd_can
from firmware_iface.errors import PortInUse
from firmware_iface.serial_link import open_serial

GROUP = "239.74.163.9"
HOST = """
import encodings.idna, os, sys
import can.interfaces.udp_multicast  # while this user may read them
from firmware_iface.can_link import open_can
from firmware_iface.serial_link import open_serial
if os.geteuid() == 0:
    if os.path.exists(sys.argv[2]):
        os.chmod(sys.argv[2], 0o666)
    os.setuid(65534)
link = open_can("udp_multicast", sys.argv[2], port=int(sys.argv[3])) if sys.argv[1] == "can" else open_serial(sys.argv[2], 9600)
print("open", flush=True)
sys.stdin.read()
"""


@contextmanager
def host(*line: str) -> Iterator[subprocess.Popen[str]]:
    """Another program, of another user where this one may say so, that has the line open."""
    process = subprocess.Popen([sys.executable, "-c", HOST, *line], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "open\n"
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.fixture
def port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        return int(free.getsockname()[1])


def test_a_bus_of_another_program_is_refused_by_name_and_free_when_that_is_killed(port: int) -> None:
    device = join_can("udp_multicast", GROUP, port=port, hop_limit=0)
    with host("can", GROUP, str(port)) as other:
        for opener in (open_can, open_fd_can) * 20:  # as often as one likes
            with pytest.raises(PortInUse, match=rf"in use by process {other.pid}\b.*-c") as refused:
                opener("udp_multicast", GROUP, port=port)
        assert "\n" not in str(refused.value)  # the program's own text is shown, not obeyed
        assert device.receive() == []
        other.send_signal(signal.SIGKILL)
        other.wait()
        open_can("udp_multicast", GROUP, port=port).close()
    device.close()


def test_another_bus_is_another_line(port: int) -> None:
    with host("can", GROUP, str(port)):
        open_can("udp_multicast", GROUP, port=port + 1, hop_limit=0).close()


def test_a_program_may_open_its_bus_more_than_once_and_has_it_until_the_last_link_closes(port: int) -> None:
    first, second = (open_can("udp_multicast", GROUP, port=port, hop_limit=0) for _ in range(2))
    first.close()
    assert not can_be_had(port)
    second.close()
    assert can_be_had(port)


def test_a_link_that_nobody_has_any_more_holds_nothing(port: int) -> None:
    open_can("udp_multicast", GROUP, port=port, hop_limit=0)._bus.shutdown()  # type: ignore[attr-defined]
    assert can_be_had(port)


def can_be_had(port: int) -> bool:
    try:
        with host("can", GROUP, str(port)):
            return True
    except AssertionError:
        return False


@pytest.fixture
def tty() -> Iterator[str]:
    ours, theirs = pty.openpty()
    yield os.ttyname(theirs)
    os.close(ours)
    os.close(theirs)


def test_a_serial_port_is_found_by_its_device_whatever_its_name(tty: str, tmp_path: Path) -> None:
    (tmp_path / "by-id").symlink_to(tty)
    with host("serial", tty) as other, pytest.raises(PortInUse, match=f"in use by process {other.pid}"):
        open_serial(str(tmp_path / "by-id"), 115_200)
    open_serial(tty, 115_200).close()


def test_a_serial_server_is_found_by_its_address(tmp_path: Path) -> None:
    with ExitStack() as closing, socket.create_server(("127.0.0.1", 0)) as server:
        number = server.getsockname()[1]
        other = closing.enter_context(host("serial", f"socket://127.0.0.1:{number}"))
        with pytest.raises(PortInUse, match=f"in use by process {other.pid}"):
            open_serial(f"socket://localhost:{number}", 115_200)


@pytest.mark.parametrize("open_it", [lambda: open_can("virtual", "x"), lambda: open_serial("loop://", 9600)])
def test_what_lives_within_a_process_is_claimed_from_nobody(
    open_it: Callable[[], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("firmware_iface.claims.Claim", None)
    link = open_it()
    link.close()  # type: ignore[attr-defined]
