"""A real CAN bus with two adapters, $ARMWRIGHT_CAN=socketcan:can0,socketcan:can1: what no test machine without them can try.

$ARMWRIGHT_CAN_FD names two that are set up for CAN FD.
"""

import os
from collections.abc import Callable, Iterator

import pytest

from firmware_iface.can_link import open_can, open_fd_can
from firmware_iface.clock import MonotonicClock
from firmware_iface.link import FrameLink

pytestmark = pytest.mark.hardware
PATIENCE_S = 0.5


def both(variable: str, opener: Callable[..., FrameLink]) -> Iterator[list[FrameLink]]:
    named = os.environ.get(variable, "")
    if named.count(",") != 1:
        pytest.skip(f"no real bus: ${variable} names two channels on one bus, socketcan:can0,socketcan:can1")
    links = [opener(*name.split(":", 1)) for name in named.split(",")]
    yield links
    for link in links:
        link.close()


@pytest.fixture
def ends() -> Iterator[list[FrameLink]]:
    yield from both("ARMWRIGHT_CAN", open_can)


@pytest.fixture
def fd_ends() -> Iterator[list[FrameLink]]:
    yield from both("ARMWRIGHT_CAN_FD", open_fd_can)


def received(link: FrameLink, count: int) -> list[tuple[int, bytes]]:
    clock, frames = MonotonicClock(), list[tuple[int, bytes]]()
    end_s = clock.now_s() + PATIENCE_S
    while len(frames) < count and clock.now_s() < end_s:
        frames += link.receive()
    return frames


def test_frames_cross_the_bus_in_order(ends: list[FrameLink]) -> None:
    sent = [(0x100 + k % 16, bytes((k,)) * (k % 9)) for k in range(40)]
    for can_id, payload in sent:
        ends[0].send(can_id, payload)
    assert received(ends[1], len(sent)) == sent
    assert ends[0].receive() == []


def test_reading_an_empty_bus_does_not_wait(ends: list[FrameLink]) -> None:
    clock = MonotonicClock()
    begun_s = clock.now_s()
    for _ in range(100):
        ends[0].receive()
    assert clock.now_s() - begun_s < 0.02


def test_fd_frames_of_64_bytes_cross_the_bus_with_ids_of_both_lengths(fd_ends: list[FrameLink]) -> None:
    sent = [(can_id, bytes(range(64))) for can_id in (0x8001, 0x100, 0x8002, 0x200)]
    for can_id, payload in sent:
        fd_ends[0].send(can_id, payload)
    assert received(fd_ends[1], len(sent)) == sent
