"""Whether the recorded voltages are those that drove the windings: a log that was thinned out lacks what came between.

What is rough in a current follows from what is rough in its voltage, within a sample or a delay. Third differences
leave the rough part; least squares say how much of a volt's change the current that follows shows.
"""

from __future__ import annotations

import numpy as np

from calib.arrays import Array
from calib.gap.signals.recording import Recording
from control.model.arm import Arm

# Of logs at 250 to 500 samples a second 0.71 to 1.0 show where every sample is there, at most 0.58 where every second is.
SHOWN = 0.63
SURE = 0.3  # standard deviation of what shows: joints whose currents are too noisy to tell do not count
LATEST_s = 0.01  # of a delay


def not_held(arm: Arm, recording: Recording) -> str:
    """A sentence if the voltages cannot be what was held between the samples; empty if they can, or nothing tells."""
    told = [shown for j in range(arm.joint_count) if (shown := _shown(arm, recording, j)) is not None]
    if not told:
        return ""
    shares, deviations = np.array(told).T
    share = float(np.average(shares, weights=deviations**-2.0))  # a joint whose voltage is smooth says little
    if share > SHOWN:
        return ""
    rate = recording.filters.rate_Hz
    return (
        f"the currents follow {max(share, 0.0):.0%} of the quick changes of the voltages: others were held between"
        f" these samples ({rate:.0f} a second; was the log thinned out?). The voltages are not used; record every sample"
    )


def _shown(arm: Arm, recording: Recording, j: int) -> tuple[float, float] | None:
    """Share of a voltage's quick change in the currents that follow it, and its deviation; None where noise hides it."""
    period = 1.0 / recording.filters.rate_Hz
    lags = int(np.ceil(LATEST_s / period)) + 2
    resistance = next(d.resistance_ohm for d in arm.drives if d.joint == j + 1)
    square, pull, own, count = np.zeros((lags + 1, lags + 1)), np.zeros(lags + 1), 0.0, 0
    for run in recording.runs:
        current, voltage = np.diff(run.current_raw_A[:, j], 3), np.diff(run.voltage_V[:, j] / resistance, 3)
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
    return (float(np.max(factors[:-1] + factors[1:])), max(deviation, 1e-6)) if deviation < SURE else None


def _past(values: Array, lags: int) -> Array:
    """Values (m,) as (m - lags, lags + 1): each row from its own sample back."""
    return np.stack([values[lags - k : len(values) - k] for k in range(lags + 1)], axis=1)
