"""When a joint counts as stalled: at a stop, and not where the host paused."""

from __future__ import annotations

from procedures.bringup.driving import HOST_PAUSE_S, STALL_WINDOW_S, START_S, has_stalled

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
