"""Gains from a measured frequency response: a fitted model, the resulting loop, and its stability margins.

The plant is seen from the loop: commanded volts (or amperes) in one cycle to the angle measured in a later one, so hold,
transport delay and the age of counts are included. A joint driven by a voltage is q'' = b u - a q' (control.dynamics.gains), with
all delays together

    P(jw) = b exp(-jw delay) / (jw (jw + a)).

The controller is the loop's own, in its discrete form: control.servo behind the speed filter of control.hardware.measurement,

    C(z) = kp + ki T / (1 - 1/z) + kd H_pid(z) H_speed(z) (1 - 1/z) / T,   H(z) = g / (1 - (1 - g)/z),   g = T / (T + filter).

Margins are read from L = C P at the measured frequencies, interpolated in log magnitude and phase (Bode's plot); the model is
used to choose gains and to scale the response to other inertias, never in place of the measurement.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from control.dynamics.gains import Gains
from control.errors import ArmError

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]
SPEED_FILTER_S = 0.001  # of control.hardware.measurement
SLOW_POLE = 0.3  # ratio of the integral's pole to the others: costs little phase and little overshoot
LOWEST_POLE_rad_s, HIGHEST_POLE_rad_s = 3.0, 150.0
DELAYS_S = np.linspace(0.0, 0.04, 201)  # a loop of 100 Hz with boards that are asked in turn has 30 ms
NO_MOTOR = 0.8  # residual of a failed fit
FINE = 40  # interpolation points between two measured frequencies
_BISECTIONS = 40


class MarginsUnmet(ArmError):
    """No gains of this structure meet the requested margins."""


@dataclass(frozen=True, slots=True)
class Response:
    """A measured frequency response: rad/s, rising; rad per volt (or ampere); coherence squared, 0 to 1."""

    omega_rad_s: Real
    plant: Complex
    coherence: Real


@dataclass(frozen=True, slots=True)
class MotorFit:
    """P = b exp(-jw delay) / (jw (jw + a)); `residual` is the root mean square of |P_measured / P_model - 1|."""

    b: float
    a_1_s: float
    delay_s: float
    residual: float

    def response(self, omega_rad_s: Real, inertia_ratio: float = 1.0) -> Complex:
        """The model for an inertia that is larger by a ratio: b and a are inversely proportional to it."""
        s = 1j * omega_rad_s
        b, a = self.b / inertia_ratio, self.a_1_s / inertia_ratio
        return np.asarray(b * np.exp(-s * self.delay_s) / (s * (s + a)), dtype=np.complex128)


@dataclass(frozen=True, slots=True)
class Margins:
    """Stability margins of a loop: gain in dB (inf: the phase stays above -180 deg), phase, crossover, peak of |S|."""

    gain_dB: float
    phase_deg: float
    crossover_rad_s: float
    sensitivity: float

    def meet(self, gain_dB: float, phase_deg: float) -> bool:
        """Whether both margins are met; NaN meets none."""
        return self.gain_dB >= gain_dB and self.phase_deg >= phase_deg


@dataclass(frozen=True, slots=True)
class LoopDesign:
    """Gains, their poles, and the margins in the measured pose and at the worst inertia."""

    gains: Gains
    pole_rad_s: float
    here: Margins
    worst: Margins


def pole_gains(fit: MotorFit, inertia_ratio: float, filter_s: float, pole_rad_s: float) -> Gains:
    """Return the gains that make (s + w)^2 (s + r w) of s^3 + (a + b kd) s^2 + b kp s + b ki, without the delay; r = SLOW_POLE.

    Where the back-EMF damps more than that, kd is zero.
    """
    w, r = pole_rad_s, SLOW_POLE
    b, a = fit.b / inertia_ratio, fit.a_1_s / inertia_ratio
    return Gains((1.0 + 2.0 * r) * w * w / b, r * w**3 / b, max((2.0 + r) * w - a, 0.0) / b, filter_s)


def fit_motor(response: Response) -> MotorFit:
    """Fit the model by least squares in 1/P, linear in 1/b and a/b for each delay; frequencies are weighted by coherence.

    Raises ArmError if the response does not fall with frequency as a motor's does.
    """
    omega, plant = response.omega_rad_s, response.plant
    weight = np.sqrt(np.clip(response.coherence, 0.0, 1.0))
    best: MotorFit | None = None
    for delay_s in DELAYS_S.tolist():
        # |P exp(jw delay) (A s^2 + B s) - 1| = min, with A = 1/b and B = a/b: relative errors, like the residuals.
        turned = plant * np.exp(1j * omega * delay_s)
        columns = np.stack((turned * (1j * omega) ** 2, turned * (1j * omega)), axis=1) * weight[:, None]
        matrix = np.concatenate((columns.real, columns.imag))
        right = np.concatenate((weight, np.zeros_like(weight)))
        (inverse_b, a_over_b), *_ = np.linalg.lstsq(matrix, right, rcond=None)
        if not inverse_b > 0.0:
            continue
        a = max(float(a_over_b / inverse_b), 0.0)
        trial = MotorFit(float(1.0 / inverse_b), a, delay_s, 0.0)
        error = np.abs(plant / trial.response(omega) - 1.0)
        residual = float(np.sqrt(np.average(error**2, weights=weight**2)))
        if best is None or residual < best.residual:
            best = MotorFit(trial.b, trial.a_1_s, trial.delay_s, residual)
    if best is None or best.residual > NO_MOTOR:
        raise ArmError("tuning: the measured response does not look like a motor's: it does not fall with frequency")
    return best


def controller(gains: Gains, period_s: float, omega_rad_s: Real) -> Complex:
    """C(exp(jwT)) of the loop's PID with its filters, positive from error to output."""
    back = np.exp(-1j * omega_rad_s * period_s)  # 1/z

    def low_pass(filter_s: float) -> Complex:
        g = period_s / (period_s + filter_s)
        return np.asarray(g / (1.0 - (1.0 - g) * back), dtype=np.complex128)

    derivative = low_pass(gains.derivative_filter_s) * low_pass(SPEED_FILTER_S) * (1.0 - back) / period_s
    return np.asarray(gains.kp + gains.ki * period_s / (1.0 - back) + gains.kd * derivative, dtype=np.complex128)


def margins(omega_rad_s: Real, loop: Complex) -> Margins:
    """Margins of a loop given at discrete frequencies.

    Gain: the smallest factor, up or down, that brings |L| to 1 where its phase is -180 deg. Phase: the smallest distance from
    -180 deg where |L| is 1; NaN if |L| never is 1. The crossover is then infinite or 0, since it lies outside the measured range.
    """
    omega, loop = _refined(omega_rad_s, loop)
    magnitude_dB = 20.0 * np.log10(np.abs(loop))
    phase_deg = np.degrees(np.unwrap(np.angle(loop)))
    phase_deg -= 360.0 * np.round((phase_deg[0] + 135.0) / 360.0)  # a motor's loop begins between -180 and -90 deg
    crossings = np.flatnonzero(np.diff(np.sign(magnitude_dB)) != 0)
    if not crossings.size:
        return Margins(math.nan, math.nan, math.inf if magnitude_dB[0] > 0.0 else 0.0, math.nan)
    phases = [180.0 + phase_deg[k] for k in crossings]
    reversals = np.flatnonzero(np.diff(np.floor((phase_deg + 180.0) / 360.0)) != 0)
    # Where the phase falls through -180 deg and |L| is above 1, the closed loop is unstable: no margin at all.
    is_unstable = any(magnitude_dB[k] > 0.0 and phase_deg[k + 1] < phase_deg[k] for k in reversals)
    distances_dB = [abs(float(magnitude_dB[k])) for k in reversals]
    gain_dB = -math.inf if is_unstable else min(distances_dB, default=math.inf)
    return Margins(gain_dB, float(min(phases)), float(omega[crossings[-1]]), float(np.max(1.0 / np.abs(1.0 + loop))))


def _refined(omega: Real, loop: Complex) -> tuple[Real, Complex]:
    """Between measured frequencies: straight lines in Bode's plot."""
    logarithm = np.log(omega)
    fine = np.concatenate([np.linspace(a, b, FINE, endpoint=False) for a, b in pairwise(logarithm)] + [logarithm[-1:]])
    magnitude = np.interp(fine, logarithm, np.log(np.abs(loop)))
    phase = np.interp(fine, logarithm, np.unwrap(np.angle(loop)))
    return np.exp(fine), np.asarray(np.exp(magnitude + 1j * phase), dtype=np.complex128)


class Tuner:
    """Designs for one joint. `inertia_ratios`: the joint's range of inertias over that of the measured pose."""

    def __init__(
        self, response: Response, fit: MotorFit, period_s: float, filter_s: float, inertia_ratios: Sequence[float] = (1.0,)
    ) -> None:
        self._response, self._fit, self._period_s, self._filter_s = response, fit, period_s, filter_s
        self._ratios = tuple(inertia_ratios)

    def margins_of(self, gains: Gains, inertia_ratio: float = 1.0) -> Margins:
        """Margins of any gains on the measured plant, scaled by the model to another inertia."""
        omega = self._response.omega_rad_s
        moved = self._response.plant * self._fit.response(omega, inertia_ratio) / self._fit.response(omega)
        return margins(omega, controller(gains, self._period_s, omega) * moved)

    def design_at(self, pole_rad_s: float) -> LoopDesign:
        """The design with poles for the largest inertia (control.dynamics.gains), and its margins."""
        largest = max(self._ratios)
        gains = pole_gains(self._fit, largest, self._filter_s, pole_rad_s)
        at_inertias = [self.margins_of(gains, ratio) for ratio in self._ratios]
        worst = Margins(
            min(m.gain_dB for m in at_inertias),
            min(m.phase_deg for m in at_inertias),
            min(m.crossover_rad_s for m in at_inertias),
            max(m.sensitivity for m in at_inertias),
        )
        if any(math.isnan(m.phase_deg) for m in at_inertias):
            worst = Margins(math.nan, math.nan, math.nan, math.nan)
        return LoopDesign(gains, pole_rad_s, self.margins_of(gains), worst)

    def fastest(self, gain_dB: float, phase_deg: float) -> LoopDesign:
        """The fastest poles that meet the margins in all poses. Raises MarginsUnmet if there are none."""
        poles = np.geomspace(HIGHEST_POLE_rad_s, LOWEST_POLE_rad_s, 120)
        for pole in poles.tolist():
            design = self.design_at(pole)
            if design.worst.meet(gain_dB, phase_deg):
                return design
        tried = [self.design_at(pole).worst for pole in poles.tolist()]
        most = max((worst.phase_deg for worst in tried if worst.gain_dB >= gain_dB), default=math.nan)
        raise MarginsUnmet(
            f"no gains reach margins of {gain_dB:g} dB and {phase_deg:g} deg: the largest phase margin with {gain_dB:g} dB is"
            f" {most:.0f} deg; check backlash and compliance between motor and joint, and delay in the loop"
        )

    def at_bandwidth(self, crossover_rad_s: float, gain_dB: float, phase_deg: float) -> LoopDesign:
        """The design whose loop crosses over at this frequency in the measured pose. Raises MarginsUnmet."""
        best = self.fastest(gain_dB, phase_deg)
        low, high = LOWEST_POLE_rad_s, best.pole_rad_s
        for _ in range(_BISECTIONS):
            middle = math.sqrt(low * high)
            reached = self.design_at(middle).here.crossover_rad_s
            low, high = (middle, high) if reached < crossover_rad_s else (low, middle)
        design = self.design_at(math.sqrt(low * high))
        is_there = math.isclose(design.here.crossover_rad_s, crossover_rad_s, rel_tol=0.05)
        if is_there and design.worst.meet(gain_dB, phase_deg):
            return design
        raise MarginsUnmet(
            f"a bandwidth of {crossover_rad_s / (2 * math.pi):.2g} Hz leaves too small margins: {gain_dB:g} dB and"
            f" {phase_deg:g} deg are met up to {best.here.crossover_rad_s / (2 * math.pi):.2g} Hz"
        )
