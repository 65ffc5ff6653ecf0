"""Counts that come without a time, from boards that send at a rate of their own or are asked: what speed they make."""

import math
import random
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

from control.hardware.measurement import Measurement
from control.model.drive import JointMap
from firmware_iface.node_bus import LOST, AnswersInTurn, Dating, SteadyMessages
from firmware_iface.odrive import OdriveAxis, OdriveBus
from firmware_iface.vesc import Vesc, VescBus
from hil_mocks.devices.odrive import OdriveMock, OdriveSetup
from hil_mocks.devices.vesc import VescMock, VescSetup
from tests.cell import RIGHT
from tests.firmware_iface.mock_wire import BusRig

TURNS_S = 2.0
SETTLES_S = 5.0
CYCLE_S = 0.004


class Speeds:
    """As the loop measures them, from the newest count of each drain."""

    def __init__(self) -> None:
        microradians = replace(RIGHT.drives[0], encoder_counts_per_rev=1, gear_ratio=2e6 * math.pi)
        self._measured = Measurement([JointMap(microradians)], [32])
        self.rad_s: list[float] = []

    def take(self, made_s: float, at_s: float, late_s: float) -> None:
        self._measured.update([round(1e6 * made_s)], [0], [at_s], [late_s])
        if made_s > SETTLES_S:
            self.rad_s.append(self._measured.speed_rad_s[0])

    @property
    def off(self) -> list[float]:
        return [abs(speed - 1.0) for speed in self.rad_s]


def speeds_of(
    sent_s: list[float],
    drained_s: list[float],
    by_arrival: bool = False,
    lateness_s: Callable[[float], float] = lambda sent_s: 0.0,
) -> Speeds:
    """Of messages sent at these times, each of which comes so late, none before the one sent before it."""
    speeds, steady, waiting = Speeds(), SteadyMessages(), list(sent_s)
    for before, now in pairwise(drained_s):
        newest = None
        while waiting and waiting[0] + lateness_s(waiting[0]) <= now:
            newest = waiting.pop(0)
            steady.arrived(before, now)
            assert steady.at_s <= now
        if newest is not None:
            speeds.take(newest, *((now, 0.0) if by_arrival else (steady.at_s, steady.late_s)))
    return speeds


@pytest.mark.parametrize("period_s", [0.0039, 0.004, 0.0041, 0.01])
@pytest.mark.parametrize("late_s", [0.0, 0.0005])
def test_a_speed_is_off_by_a_few_percent_at_most_where_arrival_would_double_it(period_s: float, late_s: float) -> None:
    rng = random.Random(7)
    sent_s = [k * period_s + 1e-4 for k in range(round(12.0 / period_s))]
    drained_s = [k * 0.00407 + rng.uniform(0.0, late_s) for k in range(2900)]
    assert max(speeds_of(sent_s, drained_s).off) < 0.08
    assert max(speeds_of(sent_s, drained_s, by_arrival=True).off) > 0.15


def test_what_waited_for_a_host_that_paused_is_of_the_pause() -> None:
    sent_s = [k * 0.004 for k in range(3000)]
    drained_s = [k * 0.00407 for k in range(2900) if not 1800 < k < 1830]
    assert max(speeds_of(sent_s, drained_s).off) < 0.08


def test_a_lost_message_disturbs_a_few_speeds() -> None:
    sent_s = [k * 0.004 for k in range(3000) if k != 1800]
    off = speeds_of(sent_s, [k * 0.00407 for k in range(2900)]).off
    assert sum(share > 0.05 for share in off) <= LOST
    assert max(off) < 0.3


def stumbling(most_s: float) -> Callable[[float], float]:
    """Lateness that changes some ten times a second."""

    def lateness_s(sent_s: float) -> float:
        draw = random.Random(round(10.0 * sent_s))
        return draw.choice([0.0, draw.uniform(0.0, most_s), most_s])

    return lateness_s


@pytest.mark.parametrize("period_s", [0.002, 0.004, 0.005])
def test_messages_that_come_cycles_late_and_then_at_once_make_no_speed(period_s: float) -> None:
    sent_s = [k * period_s + 1e-4 for k in range(round(12.0 / period_s))]
    drained_s = [k * 0.00407 for k in range(2900)]
    assert max(speeds_of(sent_s, drained_s, lateness_s=stumbling(0.012)).off) < 0.35
    assert max(speeds_of(sent_s, drained_s, True, stumbling(0.012)).off) > 1.5


def speeds_of_answers(
    lateness_s: Callable[[float], float] = lambda asked_s: 0.0, lost: Callable[[int], bool] = lambda k: False
) -> Speeds:
    """Of questions at the end of each cycle, whose answers come so late, in order, if they are not lost."""
    speeds, answers, waiting = Speeds(), AnswersInTurn(), []
    for cycle in range(2500):
        now_s = cycle * CYCLE_S
        newest = None
        while waiting and waiting[0] + lateness_s(waiting[0]) < now_s:
            newest = waiting.pop(0)
            answers.arrived(now_s)
        if newest is not None:
            speeds.take(newest, answers.at_s, answers.late_s)
        answers.asked(now_s + 1e-4)
        if not lost(cycle):
            waiting.append(now_s + 1e-4)
    return speeds


def test_answers_in_their_cycle_are_dated_by_their_question() -> None:
    assert max(speeds_of_answers().off) < 1e-9


@pytest.mark.parametrize("late_cycles", [1, 2, 3])
def test_answers_that_come_cycles_late_and_then_at_once_make_no_speed(late_cycles: int) -> None:
    speeds = speeds_of_answers(stumbling(late_cycles * CYCLE_S))
    assert len(speeds.rad_s) > 1000
    assert max(speeds.off) < 0.2


def test_lateness_that_lasts_is_taken_for_a_loss_and_its_end_makes_no_speed() -> None:
    speeds = speeds_of_answers(lambda asked_s: 1.5 * CYCLE_S if 6.0 < asked_s < 8.0 else 0.0)
    assert max(speeds.off) < 0.2
    assert max(speeds.off[-200:]) < 1e-9


@pytest.mark.parametrize("in_a_row", [1, 2, LOST, 40])
def test_lost_answers_disturb_no_speed_for_long(in_a_row: int) -> None:
    off = speeds_of_answers(lost=lambda cycle: 0 <= cycle % 500 < in_a_row).off
    assert sum(share > 1e-9 for share in off) <= 3 * 2 * LOST
    assert max(off) < 0.2


def test_answers_that_nobody_asked_for_leave_the_date_as_it_is() -> None:
    """Another host's SYNC is answered, too; a doubt of a cycle in each cycle would hide a joint that is too fast."""
    answers = AnswersInTurn()
    for cycle in range(20):
        answers.asked(cycle * CYCLE_S)
        for late_s in (0.001, 0.002):
            answers.arrived(cycle * CYCLE_S + late_s)
            assert (answers.at_s, answers.late_s) == (cycle * CYCLE_S, 0.0)


def test_of_a_restarted_board_nothing_is_dated() -> None:
    answers = AnswersInTurn()
    for at_s in (1.0, 2.0):
        answers.asked(at_s)
        answers.arrived(at_s + 0.5)
    answers.forget()
    assert (answers.at_s, answers.late_s) == (Dating().at_s, 0.0)


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
        assert before_s <= board.counted.at_s <= wired.now_s() or cycle < 150 or board.counted.at_s == last[1]
        if board.counted.at_s != last[1]:
            speeds.append((board.count - last[0]) / (board.counted.at_s - last[1]) / per_turn)
            last = board.count, board.counted.at_s
    assert speeds[200:] == pytest.approx([TURNS_S] * len(speeds[200:]), rel=0.1)
