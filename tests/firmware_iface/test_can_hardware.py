"""A real CAN bus with two adapters, $ARMWRIGHT_CAN=socketcan:can0,socketcan:can1: what no test machine without them can try."""

import os
from collections.abc import Iterator

import pytest

from firmware_iface.clock import MonotonicClock
from firmware_iface.link import FrameLink, open_can

pytestmark = pytest.mark.hardware
PATIENCE_S = 0.5


@pytest.fixture
def ends() -> Iterator[list[FrameLink]]:
    named = os.environ.get("ARMWRIGHT_CAN", "")
    if named.count(",") != 1:
        pytest.skip(
            "no real bus: $ARMWRIGHT_CAN names two channels on one bus, socketcan:can0,socketcan:can1"
        )
    links = [open_can(*name.split(":", 1)) for name in named.split(",")]
    yield links
    for link in links:
        link.close()


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
