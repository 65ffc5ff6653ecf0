"""What happens between two samples, which the samples do not show.

A commanded voltage is held over a sampling period, so that current, torque and speed run up and down within it. The angles
are sampled at its corners; derivatives of what a smooth curve through them does are not those of the joint at that moment,
and a current sampled there is not the one that turned the joint. Both differences follow linearly from the voltages: each
joint as winding and inertia alone (loads are smooth, friction of a joint that moves one way is constant) is the system
    q' = v,   J v' = K i,   L i' = u - R i - K v,   u held,
whose exact response at the samples (Franklin, Powell, Workman, Digital Control of Dynamic Systems, 3rd ed., ch. 4) is
compared with what the equations of `physics` make of its sampled q. At 500 samples a second it is hardly seen, at 250 it is
more than a noise floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from calib.arrays import Array

Spectrum = npt.NDArray[np.complex128]
SHORTEST_LAG_s = 1e-6


@dataclass(frozen=True, slots=True)
class Winding:
    """One joint as its motor turns it: J with all that moves with it, K joint torque per ampere, R, L/R."""

    inertia_kg_m2: float
    torque_per_A: float
    resistance_ohm: float
    lag_s: float


@dataclass(frozen=True, slots=True)
class Response:
    """Per volt, at frequencies (f,): sampled current, and sampled angle times j omega (a smooth curve's speed)."""

    omega: Array
    current: Spectrum
    speed: Spectrum
    later: Spectrum  # one period


def response(winding: Winding, period_s: float, delay_s: float, frequencies_Hz: Array) -> Response:
    """The response at the end of each period to voltages that take effect `delay_s` after its beginning."""
    whole, within = divmod(delay_s, period_s)
    lag = max(winding.lag_s, SHORTEST_LAG_s)
    J, K, R = winding.inertia_kg_m2, winding.torque_per_A, winding.resistance_ohm
    plant = np.zeros((4, 4))
    plant[0, 1], plant[1, 2] = 1.0, K / J
    plant[2] = 0.0, -K / (R * lag), -1.0 / lag, 1.0 / (R * lag)
    older, newer = expm(plant * within), expm(plant * (period_s - within))
    step = newer[:3, :3] @ older[:3, :3]
    omega = 2.0 * np.pi * frequencies_Hz
    z: Spectrum = np.exp(1j * omega * period_s)
    drive = (newer[:3, :3] @ older[:3, 3])[None, :] / z[:, None] + newer[:3, 3]
    moving = omega > 0.0
    states = np.zeros((len(omega), 3), dtype=np.complex128)
    matrices = z[moving, None, None] * np.eye(3) - step
    driven = (drive * (z**-whole)[:, None])[moving, :, None]
    states[moving] = np.linalg.solve(matrices, driven)[..., 0].astype(np.complex128)
    speed = np.where(
        moving, 1j * omega * states[:, 0], 1.0 / K
    )  # what keeps still in voltage turns without current
    return Response(omega, states[:, 2], speed, 1.0 / z)


class Staircase:
    """The differences along every run, for `physics` to add."""

    def __init__(self, windings: Sequence[Winding], period_s: float, voltages: Sequence[Array]) -> None:
        """`voltages`: filtered, (m, n) of each run."""
        self._windings, self._period = tuple(windings), period_s
        self._lengths = [len(run) for run in voltages]
        self._spectra: list[Spectrum] = [_spectrum(run) for run in voltages]
        self._kept: dict[tuple[str, float], list[Array]] = {}

    def of_sampled_current(self, delay_s: float) -> list[Array]:
        """Sampled current less (settled voltage - K (speed - L/R acceleration)) / R, [A] (m, n) of each run."""
        return self._along("sampled", delay_s)

    def of_mean_current(self, delay_s: float) -> list[Array]:
        """The current that accelerates as the smooth curve does, less the sampled one, [A] (m, n) of each run."""
        return self._along("mean", delay_s)

    def of_driven_current(self, delay_s: float) -> list[Array]:
        """The same less what late voltage and smooth speed say of it, for runs without a current, [A] (m, n) of each."""
        return self._along("driven", delay_s)

    def _along(self, what: str, delay_s: float) -> list[Array]:
        key = (what, delay_s)
        if key not in self._kept:
            while len(self._kept) > 8:
                self._kept.pop(next(iter(self._kept)))
            gains = {size: self._gains(what, delay_s, size) for size in {len(s) for s in self._spectra}}
            self._kept[key] = [
                np.asarray(np.fft.irfft(spectrum * gains[len(spectrum)], axis=0)[:length])
                for spectrum, length in zip(self._spectra, self._lengths, strict=True)
            ]
        return self._kept[key]

    def _gains(self, what: str, delay_s: float, size: int) -> Spectrum:
        """Of all joints (size, n), for runs of so many frequencies."""
        frequencies: Array = np.arange(size) / (2 * (size - 1) * self._period)
        gains = [_gain(what, w, self._period, delay_s, frequencies) for w in self._windings]
        return np.stack(gains, axis=1)


def _gain(what: str, winding: Winding, period_s: float, delay_s: float, frequencies_Hz: Array) -> Spectrum:
    found = response(winding, period_s, delay_s, frequencies_Hz)
    J, K, R, lag = winding.inertia_kg_m2, winding.torque_per_A, winding.resistance_ohm, winding.lag_s
    by_speed = K / R * (1.0 - 1j * found.omega * lag) * found.speed
    wanted = J * 1j * found.omega * found.speed / K
    match what:
        case "sampled":
            first, second, third = settled_shares(lag, period_s, delay_s)
            newest = found.later ** (1 + delay_s // period_s)
            settled = newest * (first + found.later * (second + found.later * third))
            return np.asarray(found.current - (settled / R - by_speed))
        case "mean":
            return np.asarray(wanted - found.current)
        case _:
            shifted = 1.0 - 1j * found.omega * (0.5 * period_s + delay_s + lag)
            return np.asarray(wanted - (shifted / R - by_speed))


def settled_shares(lag_s: float, period_s: float, delay_s: float) -> tuple[float, float, float]:
    """Weights of the newest three voltages in what a winding of this L/R has settled to at the end of a period."""
    within = delay_s % period_s
    lag = max(lag_s, SHORTEST_LAG_s)
    newest, whole = float(np.exp(-(period_s - within) / lag)), float(np.exp(-period_s / lag))
    return 1.0 - newest, newest * (1.0 - whole), newest * whole


def _spectrum(values: Array) -> Spectrum:
    """Of values (m, n) that go back to their beginning beyond their end, so that neither end is a step."""
    length = 1 << (2 * len(values) - 1).bit_length()
    back = np.linspace(0.0, 1.0, length - len(values))[:, None]
    whole = np.vstack([values, values[-1] + (values[0] - values[-1]) * back])
    return np.asarray(np.fft.rfft(whole, axis=0)).astype(np.complex128)
