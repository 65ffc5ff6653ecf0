"""Whether the recorded voltages are those that drove the windings: a log that was thinned out lacks what came between.

What is rough in a current follows from what is rough in its voltage, within a sample or a delay. Third differences
leave the rough part; least squares say how much of a volt's change the current that follows shows. A motor that turns away
under its voltage draws less at the end of a slow sample: what the windings and masses alone would show is the measure.
"""

from __future__ import annotations

import numpy as np

from calib.arrays import Array
from calib.gap.signals.body import BodyTorques
from calib.gap.signals.recording import RunSet
from control.model.arm import Arm

# Of what should show: whole logs at 100 to 1000 samples a second have 0.7 to 1.2, those of which every second to tenth sample
# is there at most 0.65 in most cases.
SHOWN = 0.68
SURE = 0.3  # standard deviation of what shows: joints whose currents are too noisy to tell do not count
LATEST_s = 0.01  # of a delay


def not_held(arm: Arm, recording: RunSet) -> str:
    """A sentence if the voltages cannot be what was held between the samples; empty if they can, or nothing tells."""
    share = shown(arm, recording)
    if share is None or share > SHOWN:
        return ""
    rate = recording.filters.rate_Hz
    return (
        f"the currents follow the quick changes of the voltages to {max(share, 0.0):.0%}: others were held between"
        f" these samples ({rate:.0f} a second; was the log thinned out?). The voltages are not used; record every sample"
    )


def shown(arm: Arm, recording: RunSet) -> float | None:
    """What the currents show of the voltages' quick changes over what they should; None where noise hides it."""
    period = 1.0 / recording.filters.rate_Hz
    windings = BodyTorques(arm, recording).windings()[0]
    # A motor turns away under its voltage, and its current goes back: what is left of it in the mean over a sample.
    turned = period * windings.torque_per_A**2 / np.diag(windings.inertia_kg_m2) / windings.resistance_ohm
    expected = -np.expm1(-turned) / turned
    told = []
    for drive in arm.drives:
        j = drive.joint - 1
        found = _followed(recording, j, drive.resistance_ohm)
        if found is not None and found[1] < SURE:
            told.append(np.array(found) / expected[j])
    if not told:
        return None
    shares, deviations = np.array(told).T
    return float(np.average(shares, weights=deviations**-2.0))  # a joint whose voltage is smooth says little


def _followed(recording: RunSet, j: int, resistance_ohm: float) -> tuple[float, float] | None:
    """Share of a voltage's quick change in the currents that follow it, and its deviation; None where it never changes."""
    period = 1.0 / recording.filters.rate_Hz
    lags = int(np.ceil(LATEST_s / period)) + 2
    square, pull, own, count = np.zeros((lags + 1, lags + 1)), np.zeros(lags + 1), 0.0, 0
    for run in recording.runs:
        current = np.diff(run.current_raw_A[:, j], 3)
        voltage = np.diff(run.voltage_V[:, j] / resistance_ohm, 3)
        if len(current) <= 2 * lags or np.any(run.is_off[:, j]):
            continue
        past, seen = _past(voltage, lags), current[lags:]
        square += past.T @ past
        pull += past.T @ seen
        own += float(seen @ seen)
        count += len(seen)
    if not count or float(np.trace(square)) == 0.0:
        return None
    square += 1e-9 * float(np.trace(square)) * np.eye(lags + 1)
    factors = np.linalg.solve(square, pull)
    noise = max(own - float(factors @ pull), 0.0) / count
    deviation = float(np.sqrt(noise * np.max(np.diag(np.linalg.inv(square)))))
    # A delay that is no whole number of samples divides a change between two of them.
    return float(np.max(factors[:-1] + factors[1:])), max(deviation, 1e-6)


def _past(values: Array, lags: int) -> Array:
    """Values (m,) as (m - lags, lags + 1): each row from its own sample back."""
    return np.stack([values[lags - k : len(values) - k] for k in range(lags + 1)], axis=1)
