"""The wires of a mock that is late, or whose bus is full: frames keep their order, and none is a reason to end."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from typing import Any

import pytest

from firmware_iface.errors import LinkLost
from firmware_iface.link import CanFormat, FrameLink
from hil_mocks.devices.motor_inputs import Frame
from hil_mocks.wires import Picture, Pty, Wires, newest_of_each


class Robot:
    """Notes what it gets."""

    def __init__(self) -> None:
        self.outgoing: dict[CanFormat, list[Frame]] = {carried: [] for carried in CanFormat}
        self.camera_outgoing: list[Picture] = []
        self.got: list[tuple[int, CanFormat]] = []

    def from_host_can(self, can_id: int, payload: bytes, carried: CanFormat = CanFormat.STANDARD) -> None:
        self.got.append((can_id, carried))

    def from_host_serial(self, board: int, received: bytes) -> None: ...

    def from_host_camera(self, camera: int, request: bytes) -> None: ...

    def serial_outgoing(self, board: int, ahead_s: float = 0.0) -> bytes:
        return b""


@pytest.fixture
def wires() -> Iterator[Wires]:
    made = Wires([], "virtual", f"wires-{os.getpid()}", can_formats=[CanFormat.FD])
    yield made
    made.close()


@pytest.fixture
def guest(wires: Wires) -> Iterator[FrameLink]:
    link = wires.guest()
    yield link
    link.close()


def test_frames_are_passed_in_their_order_up_to_a_moment(wires: Wires, guest: FrameLink) -> None:
    robot = Robot()
    guest.send(0x101, b"")
    between_s = time.time()
    while time.time() == between_s:
        pass
    guest.send(0x102, b"")
    wires.collect()
    wires.pass_frames(robot, between_s)
    assert robot.got == [(0x101, CanFormat.STANDARD)]
    wires.pass_frames(robot)
    assert robot.got[1:] == [(0x102, CanFormat.STANDARD)]


def test_what_a_full_bus_does_not_take_is_sent_later_the_newest_of_each_id(
    wires: Wires, guest: FrameLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, bus = Robot(), wires._buses[CanFormat.STANDARD]
    sends, sent = bus.send, 0

    def full(*frame: Any) -> None:
        nonlocal sent
        if sent == 2:
            raise LinkLost("no buffer space available")
        sent += 1
        sends(*frame)

    monkeypatch.setattr(bus, "send", full)
    robot.outgoing[CanFormat.STANDARD] += [(1, b"a"), (2, b"a"), (1, b"b"), (2, b"b"), (1, b"c")]
    wires.to_host(robot)
    assert guest.receive() == [(1, b"a"), (2, b"a")]
    sent = 0
    wires.to_host(robot)
    assert guest.receive() == [(1, b"c"), (2, b"b")]
    assert robot.outgoing[CanFormat.STANDARD] == []


def test_the_newest_frame_takes_an_older_ones_place() -> None:
    assert newest_of_each([(1, b"a"), (2, b"a"), (1, b"b")]) == [(1, b"b"), (2, b"a")]


def test_a_serial_port_carries_every_byte_unchanged_whatever_its_host_has_set() -> None:
    """Ctrl-C, Ctrl-S, carriage returns and line feeds are bytes of frames; nothing is sent back to its sender."""
    every = bytes(range(256))
    port = Pty()
    host = os.open(port.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        os.write(host, every)
        assert port.read() == every
        port.write(every)
        port.settle()
        assert os.read(host, 1024) == every
        assert port.read() == b""
    finally:
        os.close(host)
        port.close()
