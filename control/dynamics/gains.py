"""Gains of a joint's position control: from arm.toml, or else by pole placement on the model; and from a measured frequency
response, by a fitted model, the resulting loop, and its stability margins.

The joint model neglects the inductance (its time constant is a fraction of a cycle). With inertia J
(the largest that the joint meets within the joint ranges, rotor included), ratio N, motor constant k, resistance R,

    J q'' = N k i,   i = (u - N k q') / R        =>   q'' = b u - a q',   b = N k / (R J),   a = (N k)^2 / (R J)

(current mode: b = N k / J, a = 0). A PID closes it to s^3 + (a + b kd) s^2 + b kp s + b ki, which is (s + w)^3 for

    kd = (3 w - a) / b,   kp = 3 w^2 / b,   ki = w^3 / b.

Where the back-EMF damps more than 3 w, kd is zero. A joint that is much lighter in some poses meets kd there with a large b:
its speed loop crosses over at b kd, of which the delay allows DAMPING_MOST_rad_s. So w is at most a third of a + b kd with
the kd that this allows; without, an arm whose folded first joint had a fifth of its inertia was unstable there.

In a loop slower than 500 Hz, w is slower in proportion and most motors damp more than that; then two poles are at -w and the
third is the motor's own, at -(a - 2 w):

    kp = (w^2 + 2 w (a - 2 w)) / b,   ki = w^2 (a - 2 w) / b.

The delay of the loop is one and a half cycles of 2 ms, counts up to 1 ms old, and the filters of the speed estimate. With it
w = 40 rad/s leaves the reference arm at least 50 degrees of phase margin (40 with 0.5 kg at the tip). The sensitivity is at
most 1.65 in every pose, the crossover at 28 to 72 rad/s. In current mode no
back-EMF damps and the derivative has to, so delay costs more: w = 25 rad/s leaves 44 degrees at the design inertia
and only 15 at joint 1 with the arm retracted. The loop scales the PID by `InertiaScale`, which restores the 44.

An encoder on the joint has the play of the gear inside the loop. To a sine of amplitude A of the motor, a joint that rubs or is
damped answers with the gain (play b; Gelb and Vander Velde 1968, no. 48)

    N(A) = 1/2 + (arcsin c + c sqrt(1 - c^2)) / pi - j (1 - c^2) / pi,   c = 1 - b/A,

and a cycle stands where L(jw) N(A) = -1 for the loop L. The speed of the joint is late by the play, and kd with it; that of
the motor is not, and back-EMF damps by it: kd = 0. And it is the integral that drives the cycle: without it there is none,
and the slower it is, the smaller is the joint's share of the play. So `gains_behind_play` puts the poles at -w, -(a - w - r
w) and -r w, r = INTEGRAL_POLE, w at most a / (2 + r): the joint's share is a fifth, where three poles at -40 leave it up to a
half. A joint that its weight presses against a flank rests there. One without any friction or load floats in its play,
whatever the gains: the motor pushes it, it coasts to the other flank, and is pushed back. On the mock a thousandth of the
motor's torque as friction ends that.

Tuned on a measured response, the plant is seen from the loop: commanded volts (or amperes) in one cycle to the angle measured
in a later one, so hold, transport delay and the age of counts are included. A joint driven by a voltage is q'' = b u - a q',
with all delays together

    P(jw) = b exp(-jw delay) / (jw (jw + a)).

The controller is the loop's own, in its discrete form: control.servo behind the speed filter of control.hardware.measurement,

    C(z) = kp + ki T / (1 - 1/z) + kd H_pid(z) H_speed(z) (1 - 1/z) / T,   H(z) = g / (1 - (1 - g)/z),   g = T / (T + filter).

Margins are read from L = C P at the measured frequencies, interpolated in log magnitude and phase (Bode's plot); the model is
used to choose gains and to scale the response to other inertias, never in place of the measurement.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from control.dynamics.dynamics import Dynamics
from control.errors import ArmError, MissingModel
from control.model.arm import Arm, Drive, DrivePid

POLE_rad_s = 40.0
CURRENT_MODE_POLE_rad_s = 25.0
POLE_PERIOD_S = 0.002  # of the loop for which the poles were chosen
DAMPING_MOST_rad_s = 110.0  # 8 to 9 dB of gain margin in the lightest pose, as at joint 1 of the reference arm
_POSES = 200
INTEGRAL_POLE = 0.05  # of an encoder behind play, over the others: see the top
DERIVATIVE_FILTER_S = 0.001  # half a cycle: just enough to smooth the encoder's quantisation


@dataclass(frozen=True, slots=True)
class Gains:
    """At the joint; kp in V/rad, ki in V/(rad s), kd in V s/rad, in current mode with A for V."""

    kp: float
    ki: float
    kd: float
    derivative_filter_s: float


def gains_of(arm: Arm, joint: int, period_s: float = POLE_PERIOD_S) -> Gains:
    """Return the gains of a joint (1-based); MissingModel if neither the file nor the masses determine them.

    `period_s`: of the loop. The delays are so many cycles long, so a slower loop gets poles that are slower by as much.
    """
    drive = arm.drive(joint)
    pid = drive.pid
    filter_s = DERIVATIVE_FILTER_S if pid.derivative_filter_s is None else pid.derivative_filter_s
    if pid.kp is not None and pid.ki is not None and pid.kd is not None:
        return Gains(pid.kp, pid.ki, pid.kd, filter_s)
    pole_rad_s = CURRENT_MODE_POLE_rad_s if pid.mode == "current" else POLE_rad_s
    slowness, is_slow = min(1.0, POLE_PERIOD_S / period_s), period_s > POLE_PERIOD_S
    pole_rad_s *= slowness
    least, largest = _inertia_range_kg_m2(arm, joint)
    if pid.mode != "current":  # there the loop scales the gains by the pose
        a = (drive.gear_ratio * drive.torque_constant_Nm_A) ** 2 / (drive.resistance_ohm * largest)
        pole_rad_s = min(pole_rad_s, (a + slowness * DAMPING_MOST_rad_s * least / largest) / 3.0)
    placed = placed_gains(drive, largest, filter_s, pole_rad_s, is_slow)
    return Gains(
        placed.kp if pid.kp is None else pid.kp,
        placed.ki if pid.ki is None else pid.ki,
        placed.kd if pid.kd is None else pid.kd,
        filter_s,
    )


def volt_gains_of(arm: Arm, joint: int) -> Gains:
    """Return the gains in volts with which a motor board holds a joint (1-based) by its own encoder, in any mode."""
    drives = (
        replace(drive, pid=DrivePid()) if drive.pid.mode == "current" else drive
        for drive in (drive.at_motor for drive in arm.drives)
    )
    return gains_of(replace(arm, drives=tuple(drives)), joint)


def has_play_in_loop(drive: Drive) -> bool:
    """Whether the loop sees the joint beyond its gear, and the motor's back-EMF damps by the motor's own speed."""
    return drive.encoder_on == "joint" and drive.pid.mode == "voltage"


def gains_behind_play(b: float, a: float, filter_s: float, pole_rad_s: float) -> Gains:
    """Return the gains for an encoder behind play, of a joint q'' = b u - a q'."""
    w = min(pole_rad_s, a / (2.0 + INTEGRAL_POLE))
    integral, fast = INTEGRAL_POLE * w, a - (1.0 + INTEGRAL_POLE) * w
    return Gains((w * fast + integral * (w + fast)) / b, integral * w * fast / b, 0.0, filter_s)


def placed_gains(
    drive: Drive, inertia_kg_m2: float, filter_s: float, pole_rad_s: float = POLE_rad_s, leaves_third: bool = False
) -> Gains:
    """Return the gains that put three poles at -pole for a joint of this inertia.

    `leaves_third`: only two, if its back-EMF damps more than three such poles would. An encoder behind play has other poles.
    """
    constant = drive.gear_ratio * drive.torque_constant_Nm_A
    if drive.pid.mode == "current":
        b, a = constant / inertia_kg_m2, 0.0
    else:
        b = constant / (drive.resistance_ohm * inertia_kg_m2)
        a = constant * b
    if has_play_in_loop(drive):
        return gains_behind_play(b, a, filter_s, pole_rad_s)
    w = pole_rad_s
    third = max(w, a - 2.0 * w) if leaves_third else w
    return Gains((w * w + 2.0 * w * third) / b, w * w * third / b, max(3.0 * w - a, 0.0) / b, filter_s)


class InertiaScale:
    """Scale of each joint's derived gains in current mode: its inertia in a pose over its largest inertia.

    1 for a joint in another mode, or whose gains are in arm.toml. `unknown` holds the smallest scales, for an arm whose pose is
    not known.
    """

    def __init__(self, arm: Arm) -> None:
        joints = range(1, arm.joint_count + 1)
        self._largest = tuple(_inertia_range_kg_m2(arm, joint)[1] for joint in joints)
        pids = [drive.pid for drive in arm.drives]
        self._is_derived = tuple(pid.mode == "current" and pid.kp is None for pid in pids)
        self._mass_matrix = Dynamics(arm).mass_matrix
        self.unknown = self._shares(_inertias_kg_m2(Dynamics(arm), arm.limits_rad).min(axis=0).tolist())

    def __call__(self, q_rad: Sequence[float]) -> tuple[float, ...]:
        """Scales of all joints, above 0 and at most about 1."""
        rows = self._mass_matrix(q_rad)
        return self._shares([row[joint] for joint, row in enumerate(rows)])

    def _shares(self, inertias: Sequence[float]) -> tuple[float, ...]:
        each = zip(inertias, self._largest, self._is_derived, strict=True)
        return tuple(inertia / largest if is_derived else 1.0 for inertia, largest, is_derived in each)


def _inertia_range_kg_m2(arm: Arm, joint: int) -> tuple[float, float]:
    """The least and the largest inertia of a joint over random poses within the joint ranges."""
    try:
        inertias = _inertias_kg_m2(Dynamics(arm), arm.limits_rad)
    except MissingModel as error:
        needs = f"gains of joint {joint}: [drive.pid] has no kp, ki, kd, and they cannot be derived"
        raise MissingModel(f"{needs}: {error}") from None
    least, largest = float(inertias[:, joint - 1].min()), float(inertias[:, joint - 1].max())
    if largest <= 0.0:
        raise MissingModel(
            f"arm {arm.name}: gains of joint {joint} cannot be derived, its inertia is zero; "
            "give rotor_inertia_kg_m2, or kp, ki, kd in [drive.pid]"
        )
    return least, largest


@lru_cache(maxsize=8)
def _inertias_kg_m2(dynamics: Dynamics, limits_rad: tuple[tuple[float, float], ...]) -> NDArray[np.float64]:
    """Each joint's inertia in random poses within the joint ranges (one turn if unlimited), with a fixed seed."""
    lower, upper = np.clip(np.array(limits_rad), -np.pi, np.pi).T
    poses = np.random.default_rng(0).uniform(lower, upper, (_POSES, dynamics.joint_count))
    return np.diagonal(dynamics.mass_matrices(poses), axis1=1, axis2=2)


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
