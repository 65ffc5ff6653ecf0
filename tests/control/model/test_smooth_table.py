"""A map's table: through its nodes, smooth to the second derivative, constant beyond its ends or once round."""

from math import cos, sin, tau

import pytest

from control.model.maps import SmoothTable

VALUES = (0.001, -0.002, 0.0005, 0.003, 0.003, -0.001, 0.0)
TABLE, RING = SmoothTable(VALUES, -1.0, 2.0), SmoothTable(VALUES, 0.0, tau, is_periodic=True)


@pytest.mark.parametrize("table", [TABLE, RING], ids=["open", "round"])
def test_a_table_goes_through_its_nodes(table) -> None:
    lower, step = (-1.0, 0.5) if table is TABLE else (0.0, tau / len(VALUES))
    for k, value in enumerate(VALUES):
        assert table(lower + k * step) == pytest.approx(value, abs=1e-15)


@pytest.mark.parametrize("table", [TABLE, RING], ids=["open", "round"])
@pytest.mark.parametrize("x", [-0.97, -0.5, 0.123, 0.8, 1.5, 1.97])
def test_slope_and_bend_are_the_derivatives(table, x) -> None:
    h = 1e-4
    value, slope, bend = table.derivatives(x)
    assert value == table(x)
    assert slope == pytest.approx((table(x + h) - table(x - h)) / (2 * h), abs=1e-8)
    after, before = (table.derivatives(x + d)[1] for d in (h, -h))
    assert bend == pytest.approx((after - before) / (2 * h), abs=1e-5)


def test_beyond_its_ends_a_table_stays_without_a_kink() -> None:
    assert TABLE.derivatives(-3.0) == (VALUES[0], 0.0, 0.0)
    assert TABLE.derivatives(5.0) == (VALUES[-1], 0.0, 0.0)
    assert TABLE.derivatives(-1.0)[1] == pytest.approx(0.0, abs=1e-15)
    assert TABLE.derivatives(2.0)[1] == pytest.approx(0.0, abs=1e-15)


def test_a_table_of_a_turn_goes_round_any_number_of_times() -> None:
    for x in (0.3, 3.0, 6.2):
        assert RING(x + 3 * tau) == pytest.approx(RING(x), abs=1e-15)
        assert RING(x - 2 * tau) == pytest.approx(RING(x), abs=1e-15)
    assert RING.derivatives(tau - 1e-9)[1] == pytest.approx(RING.derivatives(1e-9)[1], abs=1e-9)


def test_six_nodes_a_period_follow_a_wave_to_a_hundredth() -> None:
    wave = SmoothTable([sin(8 * tau * k / 48) for k in range(48)], 0.0, tau, is_periodic=True)
    assert max(abs(wave(0.01 * k) - sin(8 * 0.01 * k)) for k in range(600)) < 0.01
    assert wave.derivatives(0.2)[1] == pytest.approx(8 * cos(8 * 0.2), rel=0.1)
