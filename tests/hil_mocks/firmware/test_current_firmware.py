"""The firmware's fast current loop on a motor winding: steps, the limit in every mode, no wind-up."""

from __future__ import annotations

import ctypes

import pytest

from hil_mocks.firmware import OutputStructure, library, size_of
from tests.firmware import needs_compiler

pytestmark = needs_compiler
PERIOD_S, R_ohm, L_H = 50e-6, 1.0, 1e-3
VOLTAGE, CURRENT = 1, 2
SUPPLY_uV = 24_000_000


class Winding:
    """A winding behind a bridge: L di/dt = u - R i - e. The voltage of a period comes of the current of the last one."""

    def __init__(self) -> None:
        self.current_A, self.emf_V = 0.0, 0.0
        self._loop = ctypes.create_string_buffer(size_of("current"))
        gains = (ctypes.c_int32 * 3)(6283, 6_283_185, 50)  # 1 kHz
        library().aw_current_init(self._loop, gains)

    def run(self, duration_s: float, kind: int, value: int, limit_mA: int = 5000) -> list[float]:
        """Currents [A] after each period; `volts` has the last voltage."""
        currents = []
        for _ in range(round(duration_s / PERIOD_S)):
            measured = round(1e3 * self.current_A)
            wanted = OutputStructure(kind, value)
            micro_V = library().aw_current_step(self._loop, wanted, limit_mA, SUPPLY_uV, measured)
            self.volts = 1e-6 * micro_V
            for _ in range(10):
                slope_A_s = (self.volts - R_ohm * self.current_A - self.emf_V) / L_H
                self.current_A += 0.1 * PERIOD_S * slope_A_s
            currents.append(self.current_A)
        return currents


def test_a_current_follows_within_a_millisecond_without_overshoot() -> None:
    winding = Winding()
    currents = winding.run(0.005, CURRENT, 2000)
    assert max(currents) < 2.1
    assert currents[20:] == pytest.approx([2.0] * (len(currents) - 20), abs=0.06)


def test_a_back_emf_is_no_lasting_error() -> None:
    winding = Winding()
    winding.run(0.003, CURRENT, -1500)
    winding.emf_V = 9.0
    assert winding.run(0.008, CURRENT, -1500)[-1] == pytest.approx(-1.5, abs=0.01)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_stalled_motor_at_full_voltage_stays_within_its_limit(sign: int) -> None:
    winding = Winding()
    currents = winding.run(0.01, VOLTAGE, sign * SUPPLY_uV, 5000)
    assert max(abs(current) for current in currents) < 5.3
    assert currents[-1] == pytest.approx(sign * 5.0, abs=0.05)


def test_a_voltage_below_the_limit_is_put_out_as_it_is() -> None:
    winding = Winding()
    winding.run(0.005, VOLTAGE, 3_000_000, 5000)
    assert winding.volts == 3.0
    winding.run(0.005, VOLTAGE, -1_000_000, 5000)
    assert winding.volts == -1.0


def test_a_brake_of_a_turning_motor_stays_within_the_limit() -> None:
    winding = Winding()
    winding.emf_V = 12.0
    assert max(map(abs, winding.run(0.01, VOLTAGE, 0, 5000))) < 5.6
    winding.emf_V = 3.0
    winding.run(0.01, VOLTAGE, 0, 5000)
    assert winding.volts == 0.0


def test_nothing_winds_up_while_the_supply_does_not_suffice() -> None:
    winding = Winding()
    winding.emf_V = 23.0
    winding.run(0.1, CURRENT, 4000)
    assert winding.volts == 24.0
    winding.emf_V = 0.0
    winding.run(0.0015, CURRENT, 1000, 5000)
    assert winding.current_A == pytest.approx(1.0, abs=0.3)
