"""What happens between two samples, which the samples do not show.

A commanded voltage is held over a sampling period, so that current, torque and speed run up and down within it. The angles
are sampled at its corners; derivatives of what a smooth curve through them does are not those of the joint at that moment,
and a current sampled there is not the one that turned the joint. Both differences follow linearly from the voltages: windings
and the arm's mass matrix M alone (loads are smooth, friction of a joint that moves one way is constant) are the system
    q' = v,   M v' = K i,   L i' = u - R i - K v,   u held,
whose exact response at the samples (Franklin, Powell, Workman, Digital Control of Dynamic Systems, 3rd ed., ch. 4) is
compared with what the equations of `physics` make of its sampled q. Joints turn each other through M: at 100 samples a second
that is as much as what each does alone. At 500 samples a second all of it is hardly seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from calib.arrays import Array

Spectrum = npt.NDArray[np.complex128]
Kind = tuple[int, int]  # of a run: which windings, and how many frequencies
SHORTEST_LAG_s = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Windings:
    """An arm as its n motors turn it: M (n, n) with the rotors, joint torque per ampere, R and L/R (n,)."""

    inertia_kg_m2: Array
    torque_per_A: Array
    resistance_ohm: Array
    lag_s: Array


@dataclass(frozen=True, slots=True)
class StaircaseResponse:
    """At frequencies (f,), (f, n, n): of each joint to a volt on each: sampled current, and sampled angle times j omega (a
    smooth curve's speed); `later` (f,) is one period.
    """

    omega: Array
    current: Spectrum
    speed: Spectrum
    later: Spectrum


def response(windings: Windings, period_s: float, delay_s: float, frequencies_Hz: Array) -> StaircaseResponse:
    """The response at the end of each period to voltages that take effect `delay_s` after its beginning."""
    whole, within = divmod(delay_s, period_s)
    lag = np.maximum(windings.lag_s, SHORTEST_LAG_s)
    K, R, n = windings.torque_per_A, windings.resistance_ohm, len(windings.lag_s)
    angle, speed, current, volt = (slice(k * n, (k + 1) * n) for k in range(4))
    plant = np.zeros((4 * n, 4 * n))
    plant[angle, speed] = np.eye(n)
    plant[speed, current] = np.linalg.solve(windings.inertia_kg_m2, np.diag(K))
    plant[current, speed], plant[current, current] = np.diag(-K / (R * lag)), np.diag(-1.0 / lag)
    plant[current, volt] = np.diag(1.0 / (R * lag))
    older, newer = expm(plant * within), expm(plant * (period_s - within))
    moved, driven = slice(0, 3 * n), newer[: 3 * n, volt]
    omega = 2.0 * np.pi * frequencies_Hz
    z: Spectrum = np.exp(1j * omega * period_s)
    drive = (newer[moved, moved] @ older[moved, volt]) / z[:, None, None] + driven
    moving = omega > 0.0
    states = np.zeros((len(omega), 3 * n, n), dtype=np.complex128)
    matrices = z[moving, None, None] * np.eye(3 * n) - newer[moved, moved] @ older[moved, moved]
    states[moving] = np.linalg.solve(matrices, drive[moving] * (z[moving, None, None] ** -whole))
    smooth = 1j * omega[:, None, None] * states[:, angle]
    smooth[~moving] = np.diag(1.0 / K)  # what keeps still in voltage turns without current
    return StaircaseResponse(omega, states[:, current], smooth, 1.0 / z)


class Staircase:
    """The differences along every run, for `physics` to add."""

    def __init__(self, windings: Sequence[Windings], period_s: float, voltages: Sequence[Array]) -> None:
        """`windings` of each run, the same object where they are the same; `voltages`: filtered, (m, n) of each run."""
        self._windings, self._period = tuple(windings), period_s
        self._lengths = [len(run) for run in voltages]
        self._spectra: list[Spectrum] = [_spectrum(run) for run in voltages]
        self._kept: dict[tuple[str, float], list[Array]] = {}
        # of one delay: its differences are asked for one after another
        self._latest: tuple[float, dict[Kind, StaircaseResponse]] = np.nan, {}

    def along(self, what: Literal["sampled", "mean", "driven"], delay_s: float) -> list[Array]:
        """[A] (m, n) of each run, of commands that are late by `delay_s`; kept for those asked last.

        sampled: sampled current less (settled voltage - K (speed - L/R acceleration)) / R; mean: the current that accelerates as
        the smooth curve does, less the sampled one; driven: the same less what late voltage and smooth speed say of it.
        """
        key = (what, delay_s)
        if key not in self._kept:
            while len(self._kept) > 8:
                self._kept.pop(next(iter(self._kept)))
            if self._latest[0] != delay_s:
                self._latest = delay_s, {}
            responses = self._latest[1]
            gains: dict[Kind, Spectrum] = {}
            self._kept[key] = []
            for own, spectrum, length in zip(self._windings, self._spectra, self._lengths, strict=True):
                kind = id(own), len(spectrum)
                if kind not in responses:
                    frequencies: Array = np.arange(kind[1]) / (2 * (kind[1] - 1) * self._period)
                    responses[kind] = response(own, self._period, delay_s, frequencies)
                if kind not in gains:
                    gains[kind] = _gain(what, own, self._period, delay_s, responses[kind])
                answer = np.einsum("fij,fj->fi", gains[kind], spectrum)
                self._kept[key].append(np.asarray(np.fft.irfft(answer, axis=0)[:length]))
        return self._kept[key]


def _gain(what: str, windings: Windings, period_s: float, delay_s: float, found: StaircaseResponse) -> Spectrum:
    """(f, n, n): of each joint to a volt on each."""
    K, R, lag = windings.torque_per_A, windings.resistance_ohm, windings.lag_s
    turned = 1j * found.omega[:, None]
    by_speed = (K / R * (1.0 - turned * lag))[:, :, None] * found.speed
    wanted = turned[:, :, None] * (windings.inertia_kg_m2 @ found.speed) / K[:, None]
    own = np.eye(len(K))  # a joint's own voltage
    match what:
        case "sampled":
            first, second, third = (
                np.array(part) for part in zip(*(settled_shares(float(one), period_s, delay_s) for one in lag), strict=True)
            )
            later = found.later[:, None]
            settled = later ** (1 + delay_s // period_s) * (first + later * (second + later * third))
            return np.asarray(found.current - ((settled / R)[:, :, None] * own - by_speed))
        case "mean":
            return np.asarray(wanted - found.current)
        case _:
            shifted = 1.0 - turned * (0.5 * period_s + delay_s + lag)
            return np.asarray(wanted - ((shifted / R)[:, :, None] * own - by_speed))


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
