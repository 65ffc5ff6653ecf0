"""Counts of boards that send them at a rate of their own, without a time: what speed they make."""

import random
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest

from firmware_iface.node_bus import SteadyMessages
from firmware_iface.odrive.axis import OdriveAxis, OdriveBus
from firmware_iface.vesc.controller import Vesc, VescBus
from hil_mocks.devices.odrive import OdriveMock, OdriveSetup
from hil_mocks.devices.vesc import VescMock, VescSetup
from tests.firmware_iface.mock_wire import BusRig

TURNS_S = 2.0
SETTLES_S = 5.0


def speeds_of(sent_s: list[float], drained_s: list[float], dated: Callable[[float, float, float], float]) -> list[float]:
    """Of a motion of 1/s, message by message as it is dated: the newest one of each drain."""
    speeds, last, waiting = [], None, list(sent_s)
    for before, now in pairwise(drained_s):
        newest = None
        while waiting and waiting[0] <= now:
            newest = waiting.pop(0)
            at_s = dated(newest, before, now)
        if newest is not None:
            if last is not None and now > SETTLES_S:
                speeds.append((newest - last[0]) / (at_s - last[1]))
            last = newest, at_s
    return speeds


def tracked() -> Callable[[float, float, float], float]:
    steady = SteadyMessages()

    def dated(sent_s: float, before_s: float, now_s: float) -> float:
        steady.arrived(before_s, now_s)
        assert before_s <= steady.at_s <= now_s
        return steady.at_s

    return dated


@pytest.mark.parametrize("period_s", [0.0039, 0.004, 0.0041, 0.01])
@pytest.mark.parametrize("late_s", [0.0, 0.0005])
def test_a_speed_is_off_by_a_few_percent_at_most_where_arrival_would_double_it(period_s: float, late_s: float) -> None:
    rng = random.Random(7)
    sent_s = [k * period_s + 1e-4 for k in range(round(12.0 / period_s))]
    drained_s = [k * 0.00407 + rng.uniform(0.0, late_s) for k in range(2900)]
    assert max(abs(speed - 1.0) for speed in speeds_of(sent_s, drained_s, tracked())) < 0.08
    by_arrival = speeds_of(sent_s, drained_s, lambda sent_s, before_s, now_s: now_s)
    assert max(abs(speed - 1.0) for speed in by_arrival) > 0.15


def test_what_waited_for_a_host_that_paused_is_of_the_pause() -> None:
    sent_s = [k * 0.004 for k in range(3000)]
    drained_s = [k * 0.00407 for k in range(2900) if not 1800 < k < 1830]
    assert max(abs(speed - 1.0) for speed in speeds_of(sent_s, drained_s, tracked())) < 0.08


def test_a_lost_message_is_seen_at_once() -> None:
    sent_s = [k * 0.004 for k in range(3000) if k != 1800]
    drained_s = [k * 0.00407 for k in range(2900)]
    speeds = speeds_of(sent_s, drained_s, tracked())
    assert sum(abs(speed - 1.0) > 0.1 for speed in speeds) <= 3
    assert max(abs(speed - 1.0) for speed in speeds) < 1.0


@pytest.mark.parametrize("kind", ["odrive", "vesc"])
def test_boards_that_send_unasked_make_a_steady_speed_of_a_steady_motion(kind: str) -> None:
    rig: list[Any] = []

    def turns() -> float:
        return TURNS_S * rig[0].wired.now_s() if rig else 0.0

    board: Any
    if kind == "odrive":
        rig.append(BusRig(OdriveMock(OdriveSetup(1, 0.05, 8.0), turns), OdriveBus))
        board, per_turn = OdriveAxis(rig[0].bus, 1, "elbow", 8192), 8192
    else:
        rig.append(BusRig(VescMock(VescSetup(1, 1.0, 8.0), turns), VescBus))
        board, per_turn = Vesc(rig[0].bus, 1, "elbow"), 18_000
    wired, bus = rig[0].wired, rig[0].bus
    speeds, last = [], (0, 0.0)
    for cycle in range(400):
        if cycle == 150:  # what is sent meanwhile is lost
            for _ in range(50):
                wired.wait_until_s(wired.now_s() + 0.001)
            wired.receive()
            bus.update()
        before_s = wired.now_s()
        for _ in range(5 if cycle % 3 else 6):  # ms: 5.33 on average, to messages at 4 or 5
            wired.wait_until_s(wired.now_s() + 0.001)
        bus.update()
        assert before_s <= board.counted_at_s <= wired.now_s() or cycle < 150 or board.counted_at_s == last[1]
        if board.counted_at_s != last[1]:
            speeds.append((board.count - last[0]) / (board.counted_at_s - last[1]) / per_turn)
            last = board.count, board.counted_at_s
    assert speeds[200:] == pytest.approx([TURNS_S] * len(speeds[200:]), rel=0.1)
