"""The reference encoder board, and a host that pauses beside it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import pytest

from control.hardware.reference_boards import ReferenceEncoders
from firmware_iface.errors import BoardSilent
from tests.firmware_iface.scripted import FakeClock


@dataclass
class Board:
    """A board whose next report comes at `report_s`."""

    clock: FakeClock
    report_s: float
    where: str = "encoder board 1"
    identity: None = None
    latest: Any = None
    latest_at_s: float = -math.inf

    def update(self) -> None:
        if self.clock.now_s() >= self.report_s:
            self.latest, self.latest_at_s = SimpleNamespace(counts=[7]), self.report_s


@pytest.mark.parametrize(
    ("stale_s", "silent_s", "is_borne"), [(0.02, 0.045, True), (0.02, 0.06, False), (0.3, 0.29, True), (0.3, 0.31, False)]
)
def test_a_zero_waits_for_its_report_as_long_as_the_arm_bears_a_silent_board(
    stale_s: float, silent_s: float, is_borne: bool
) -> None:
    clock = FakeClock()
    board = Board(clock, clock.now_s() + silent_s)
    encoders = ReferenceEncoders(cast(Any, board), {0: 0}, clock, 0.002, stale_s)
    if is_borne:
        assert encoders.fresh_count(0) == 7
    else:
        with pytest.raises(BoardSilent, match="while a zero was set"):
            encoders.fresh_count(0)
