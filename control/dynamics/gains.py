"""Gains of a joint's position control: from arm.toml, or else by pole placement on the model.

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
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from control.dynamics.dynamics import Dynamics
from control.errors import MissingModel
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
