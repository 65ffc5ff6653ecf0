"""When a joint counts as stalled: at a stop, and not where the host paused; and what its integral does meanwhile."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any, cast

import pytest

from control.model.description import load_arm
from procedures.bringup.measuring import HOST_PAUSE_S, STALL_WINDOW_S, START_S, JointDriver, MotionEnd, has_stalled
from procedures.bringup.wiring import Caution, MeasuredWiring
from procedures.bringup.workbench import DriveLimits, Sample
from tests.firmware_iface.scripted import FakeClock

SPEED_rad_s = 0.3
CYCLE_S = 0.002


def rows(angles: list[float], pause_at: int | None = None) -> list[tuple[float, float, float, float, float]]:
    """Cycles of 2 ms at these angles, one of them after a pause of 0.3 s."""
    late_s = [0.3 if pause_at is not None and k >= pause_at else 0.0 for k in range(len(angles))]
    return [(k * CYCLE_S + late_s[k], angle, 0.0, 0.0, 0.0) for k, angle in enumerate(angles)]


def test_a_joint_that_stands_for_the_window_has_stalled() -> None:
    way = [SPEED_rad_s * CYCLE_S * k for k in range(200)]
    still = [way[-1]] * (int(STALL_WINDOW_S / CYCLE_S) + 2)
    assert not has_stalled(rows(way), SPEED_rad_s)
    assert has_stalled(rows(way + still), SPEED_rad_s)


def test_a_joint_has_time_to_start() -> None:
    assert not has_stalled(rows([0.0] * (int(START_S / CYCLE_S) - 2)), SPEED_rad_s)
    assert has_stalled(rows([0.0] * (int(START_S / CYCLE_S) + 3)), SPEED_rad_s)


def test_a_pause_of_the_host_is_no_stop() -> None:
    way = [SPEED_rad_s * CYCLE_S * k for k in range(200)]
    after = [way[-1]] * (int(STALL_WINDOW_S / CYCLE_S) + 2)
    assert HOST_PAUSE_S < 0.3
    assert not has_stalled(rows(way + after, pause_at=len(way)), SPEED_rad_s)
    long_after = [way[-1]] * (int(START_S / CYCLE_S) + 3)
    assert has_stalled(rows(way + long_after, pause_at=len(way)), SPEED_rad_s)


class BlockedBench:
    """A board that limits its current while joint 2 is blocked: until then the joint turns as its voltage says."""

    has_volts = True

    def __init__(self, blocked_from_s: float) -> None:
        self.clock = FakeClock(0.0)
        self.sent_V: list[tuple[float, float]] = []
        self._drive = load_arm("right").drives[1]
        self._blocked_from_s, self._turned_rad = blocked_from_s, 0.0

    def observe(self, duration_s: float) -> Sample:
        return self._sample(0.0, 0.0)

    def driving(self, node: int, limits: DriveLimits) -> AbstractContextManager[None]:
        return nullcontext()

    def cycle(self, volts: float) -> Sample:
        self.clock.wait_until_s(self.clock.now_s() + CYCLE_S)
        self.sent_V.append((self.clock.now_s(), volts))
        is_free = self.clock.now_s() < self._blocked_from_s
        speed = volts / (self._drive.gear_ratio * self._drive.torque_constant_Nm_A) if is_free else 0.0
        self._turned_rad += speed * CYCLE_S
        return self._sample(volts, speed)

    def _sample(self, volts: float, speed_rad_s: float) -> Sample:
        per_rad = self._drive.encoder_counts_per_rev * self._drive.gear_ratio / 6.283185307179586
        is_limited = self.clock.now_s() >= self._blocked_from_s
        counts = {CHANNEL: round(self._turned_rad * per_rad)}
        return Sample(self.clock.now_s(), counts, {CHANNEL: 0}, {CHANNEL: speed_rad_s * per_rad}, volts, 0.0, is_limited)


CHANNEL = cast("Any", 0)


def test_the_integral_rests_while_the_board_limits_the_current() -> None:
    bench = BlockedBench(blocked_from_s=0.5)
    driver = JointDriver(
        cast("Any", bench),
        load_arm("right").drives[1],
        MeasuredWiring(2, node=2, motor_direction=1, channel=CHANNEL, encoder_direction=1, board_holds=True),
        Caution(current_A=2.0, speed_rad_s=0.3),
    )
    assert driver.turn(1.0, SPEED_rad_s).end is MotionEnd.STALLED
    before, *meanwhile = [volts for at_s, volts in bench.sent_V if 0.49 < at_s < 0.6]
    assert meanwhile == pytest.approx([before] * len(meanwhile), rel=1e-6)
