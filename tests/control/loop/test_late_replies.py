"""A busy host, or an adapter, hands on what boards on CAN send a cycle or more late, in its order: no speed is made of that."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from control.model.arm import Arm
from control.safety.modes import Mode
from firmware_iface.can_link import CanFrameLink
from tests.cell import Cell, holding_cell, scenario
from tests.kinds import ON_BOARDS


class LateAdapter:
    """What the host receives from a CAN bus: each frame so many cycles late, which changes now and then."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, most_late: int) -> None:
        self._most_late, self._late, self._cycle = most_late, 0, 0
        self._random = random.Random(f"late {most_late}")
        self._waiting: list[tuple[int, tuple[int, bytes]]] = []
        self._receive = CanFrameLink.receive

        def receive(link: CanFrameLink) -> list[tuple[int, bytes]]:
            return self.handed_on(link)

        monkeypatch.setattr(CanFrameLink, "receive", receive)

    def handed_on(self, link: CanFrameLink) -> list[tuple[int, bytes]]:
        self._waiting += [(self._cycle, frame) for frame in self._receive(link)]
        come = [frame for cycle, frame in self._waiting if self._cycle - cycle >= self._late]
        del self._waiting[: len(come)]
        return come

    def next_cycle(self) -> None:
        self._cycle += 1
        if self._random.random() < 0.15:
            self._late = self._random.randint(0, self._most_late)


@contextmanager
def late_cell(
    arm: Arm, period_s: float, most_late: int, patch: pytest.MonkeyPatch
) -> Iterator[tuple[Cell, list[float], list[float]]]:
    """An arm behind such an adapter, the largest true speed of each cycle, and the largest measured one."""
    with holding_cell(scenario((-1.2, -0.6, 0.2)), arm, period_s=period_s) as cell:
        adapter, true_rad_s = LateAdapter(patch, most_late), cell.true_speeds()
        measured_rad_s: list[float] = []
        cell.watchers.append(adapter.next_cycle)
        cell.watchers.append(lambda: measured_rad_s.append(max(map(abs, cell.runtime.parts.measurement.speed_rad_s))))
        yield cell, true_rad_s, measured_rad_s


@pytest.mark.parametrize(("kind", "most_late"), [("cia402", 1), ("cia402", 3), ("moteus", 2)])
def test_an_answer_that_is_cycles_late_does_not_look_like_speed(
    kind: str, most_late: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_boards = ON_BOARDS[kind]
    with late_cell(on_boards.arm, on_boards.period_s, most_late, monkeypatch) as (cell, true_rad_s, measured_rad_s):
        for way in (1.0, 1.0, 1.0, 1.0, -1.0, -1.0):
            cell.client.ask("jog", joint_speed_rad_s=[way * 0.2, 0.0, 0.0])
            cell.run(0.1)
        assert (cell.mode, cell.faults) == (Mode.JOGGING, [])
        assert 0.1 < max(measured_rad_s) < 1.2 * max(true_rad_s)


def test_unasked_counts_that_are_cycles_late_are_no_overspeed(monkeypatch: pytest.MonkeyPatch) -> None:
    on_boards = ON_BOARDS["odrive"]
    homed = replace(on_boards.arm, boards=tuple(replace(board, absolute=True) for board in on_boards.arm.boards))
    with late_cell(homed, on_boards.period_s, 3, monkeypatch) as (cell, true_rad_s, measured_rad_s):
        cell.start_move((0.6, -0.6, 0.2))
        cell.until(lambda: cell.mode is not Mode.MOVING, 3.0)
        assert (cell.mode, cell.faults) == (Mode.HOLDING, [])
        assert 1.5 < max(measured_rad_s) < 1.2 * max(true_rad_s)
