"""What shows where both currents and voltages are recorded: late commands, a supply that gives way; and when a sample is read."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from calib.arrays import Array
from calib.gap.effects.columns import straight
from calib.gap.effects.departures import by_currents
from calib.gap.effects.record import EffectRecord, InSeries
from calib.gap.effects.secants import Bent, secants
from calib.gap.finding import EffectName
from calib.gap.posterior.term import Traits
from calib.gap.residuals.operating_point import OperatingPoint
from calib.gap.residuals.term import SeriesTerm
from calib.gap.signals.terms import Form

SAMPLING = "sampling time"  # of the boards; no effect of the arm, and taken off
DELAYS_s = (0.0004, 0.0008, 0.0018, 0.003, 0.0046, 0.007, 0.01)
READ_SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)  # of a period, after the voltage has changed
LATEST_s = 0.02  # of a sample after the voltage that it follows
LATE = Traits(alternative="late")  # a command is late, or what is read of it is


def _delay(around: OperatingPoint, record: EffectRecord, key: EffectName) -> Iterator[SeriesTerm]:
    yield from secants(around, record, key, Bent(DELAYS_s))


def _sampling(around: OperatingPoint, record: EffectRecord, key: EffectName) -> Iterator[SeriesTerm]:
    period_s = 1.0 / around.scene.recording.filters.rate_Hz
    yield from secants(
        around, record, key, Bent(tuple(share * period_s for share in READ_SHARES), most=period_s)
    )


def _by_duty(voltage: Array, current: Array, supply: Array) -> Array:
    """A bridge draws duty times motor current."""
    return np.asarray(np.sum(voltage / supply * current, axis=1, keepdims=True))


def _by_sum(voltage: Array, current: Array, supply: Array) -> Array:
    """All motors' currents, whatever their sign."""
    return np.asarray(np.sum(np.abs(current), axis=1, keepdims=True))


RECORDS = (
    EffectRecord(
        SAMPLING, traits=LATE,
        series=InSeries(
            (Form(SAMPLING, "sampling", 5e-5, steps=(2e-5,), lower=(0.0,), upper=(LATEST_s,)),), _sampling, "motor"
        ),
    ),
    EffectRecord(
        "command_delay", traits=LATE, needs_drives=True,
        series=InSeries(
            (Form("command_delay", "delay", 2e-4, steps=(2e-5,), lower=(0.0,), upper=(math.inf,)),), _delay, "electrical",
            over="current",
        ),
    ),
    EffectRecord(
        "supply_sag", needs_drives=True,
        series=InSeries(
            (
                Form("supply_sag", "sag", 0.01, lower=(0.0,), drawn=_by_duty),
                Form("supply_sag by sum", "sag", 0.01, lower=(0.0,), drawn=_by_sum),
            ),
            straight, "electrical", departs=(by_currents,),
            variable="current", over="current", least=lambda arm, law: 0.0,
        ),
    ),
)  # fmt: skip
