"""Terms of a model of time series: effects in their forms with their values; frictions and errors of angles along a motion."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final, Literal, Protocol

import numpy as np

from calib.arrays import Array
from calib.gap.finding import EffectName
from control.model.effects import Torque, followed_joint, moved_joint

PLAIN_STEP = 1e-3  # of finite differences of what rows follow in a straight line
TORQUES_KEPT = 256
MEANT_FOR_Nm = 30.0  # largest torque of the drives that the sizes of torques are meant for

# Where a form acts: on the torque at the motor, in the gear, between encoder and joint, on what the camera sees, on what the
# links carry, or in the electrical equations.
Acts = Literal[
    "motor",
    "spring",
    "play",
    "angle",
    "beam",
    "geometry",
    "frame",
    "payload",
    "mass",
    "inertia",
    "torque constant",
    "delay",
    "sampling",
    "sag",
]
# An angle's error: misread by the encoder at the motor, arising between motor and link, or seen by the camera alone.
Where = Literal["encoder", "behind", "seen"]
Values = tuple[float, ...]
# Of values, the angle (m,) that it follows and times (m,): the error, its first and second derivative, by the angle or by time.
AngleLaw = Callable[[Values, Array, Array], tuple[Array, Array, Array]]
Drawn = Callable[[Array, Array, Array], Array]  # of voltages and currents (m, n) and supplies (n,): the supply's current (m, 1)


@dataclass(frozen=True, slots=True, eq=False)
class Form:
    """One form of an effect in time series, with internal values, which may differ from the file's parameters."""

    name: str
    acts: Acts
    smallest: float  # size worth a name: about what a careful builder would still correct
    count: int = 1  # of values; 0: four a link
    counted: int | None = None  # of the values, those that make the size; None: all
    is_torque: bool = False  # the size is a share of the drive's torque
    # of finite differences: what changes rows by a good part of their floor and is still linear; () where rows follow in a
    # straight line anyway
    steps: tuple[float, ...] = ()
    lower: tuple[float, ...] = (-math.inf,)  # where the values mean something
    upper: tuple[float, ...] = (math.inf,)
    torque: Callable[[Values, float], Torque] | None = None  # of values and cogging's order
    is_of_motor: bool = False  # the torque follows the motor's angle
    shared: Literal["", "coulomb", "viscous"] = ""  # a friction part of which may act behind a soft or loose gear
    angle: AngleLaw | None = None
    where: Where = "encoder"
    is_by_time: bool = False  # the angle's error follows time
    drawn: Drawn | None = None

    @property
    def is_straight(self) -> bool:
        """Whether the rows follow its values in a straight line."""
        return not self.steps

    @property
    def is_gear(self) -> bool:
        """Whether it is a gear that is soft or loose: joint and motor are then at two angles."""
        return self.acts in ("spring", "play")

    def __str__(self) -> str:
        """Its name."""
        return self.name


@dataclass(frozen=True, slots=True)
class Law:
    """An effect, or something that is in no list, in one of the forms that it may have."""

    name: EffectName
    form: Form
    values: Values
    order: float = 0.0  # of cogging, which is searched and then kept

    @property
    def index(self) -> int:
        """0-based joint or link; -1 where it has none."""
        return -1 if self.name.joint is None else self.name.joint - 1

    def at(self, values: Values) -> Law:
        """The same with other values."""
        return replace(self, values=values)

    def neighbours(self) -> Iterator[tuple[Law, float]]:
        """The term with one value after the other a little larger, and by how much: for slopes."""
        steps = self.form.steps or (PLAIN_STEP,) * len(self.values)
        for place, step in enumerate(steps[: len(self.values)]):
            values = list(self.values)
            values[place] += step
            yield self.at(tuple(values)), step

    def bounded(self) -> Law:
        """With values where the effect means something."""
        count = len(self.values)
        lower, upper = (np.resize(own, count) for own in (self.form.lower, self.form.upper))
        return self.at(tuple(np.clip(self.values, lower, upper).tolist()))

    def is_worth_a_name(self, given_Nm: Array) -> bool:
        """Whether it is at least of the smallest size; `given_Nm` as of `smallest`."""
        return math.hypot(*self.values[: self.form.counted]) >= smallest(given_Nm, self.form, self.index)


def smallest(given_Nm: Array, form: Form, joint: int) -> float:
    """The size worth a name for a joint (0-based), of which given_Nm (n,) says what its motor gives; small drives have small
    frictions.
    """
    return form.smallest * min(1.0, _of_drive(given_Nm, form, joint))


def typical(given_Nm: Array, form: Form, joint: int) -> float:
    """What `smallest` is a share of: the frictions of a large drive are larger, although as little is worth a name."""
    return form.smallest * _of_drive(given_Nm, form, joint)


def _of_drive(given_Nm: Array, form: Form, joint: int) -> float:
    """A joint's torque over that of the drives that the sizes of torques are meant for; 1 for what is no torque."""
    return float(given_Nm[joint]) / MEANT_FOR_Nm if form.is_torque and joint >= 0 else 1.0


FAST, FASTEST = 0.3, 0.4  # of a turn of cogging's phase a sample: from here on it fades, and is gone


class Moving(Protocol):
    """Angles, speeds and accelerations (m, n) at times (m,)."""

    @property
    def q(self) -> Array:
        """Angles."""

    @property
    def speed(self) -> Array:
        """Speeds."""

    @property
    def acceleration(self) -> Array:
        """Accelerations."""

    @property
    def t_s(self) -> Array:
        """Times."""


def sampled_friction_Nm(term: Law, run: Moving, link_Nm: Array, gear_ratio: float, ahead_rad: Array | float = 0.0) -> Array:
    """`friction_Nm` along a run of equal samples, without what these cannot carry.

    Cogging that passes faster than the samples can follow would come back as a slow torque that never was.
    """
    torque = friction_Nm(term, run, link_Nm, gear_ratio, ahead_rad)
    if not term.form.is_of_motor:
        return torque
    period_s = float(run.t_s[1] - run.t_s[0])
    turns = np.abs(term.order * gear_ratio * run.speed[:, term.index]) * period_s / (2.0 * np.pi)  # a sample
    return np.asarray(torque * np.clip((FASTEST - turns) / (FASTEST - FAST), 0.0, 1.0))


def friction_Nm(term: Law, run: Moving, link_Nm: Array, gear_ratio: float, ahead_rad: Array | float = 0.0) -> Array:
    """Torque (m,) that the motor has to add for this term; `ahead_rad` (m,): its angle beyond what its encoder says."""
    j = term.index
    angle = (run.q[:, j] + ahead_rad) * gear_ratio if term.form.is_of_motor else run.q[:, j]
    return np.asarray(torque_of(term)(angle, run.speed[:, j], link_Nm))


def torque_of(term: Law) -> Torque:
    """What a motor has to add for a term, of the angle that it follows, the joint's speed and the transmitted torque."""
    return _torque_of(term.form, term.values, term.order)


@lru_cache(maxsize=TORQUES_KEPT)
def _torque_of(form: Form, values: Values, order: float) -> Torque:
    """The law of a torque at a motor; kept, since to make it of a record takes longer than to evaluate it for some samples."""
    if form.torque is None:
        raise ValueError(f"{form} is no torque at a motor")
    return form.torque(values, order)


# Joints that are elsewhere than their encoders say: what link and motor then really do.
#
# An encoder that errs against its motor misstates the motor's speed too, which the back-EMF shows, and its angle, by which
# cogging comes round: a milliradian at a joint is a tenth of a radian at a motor with a gear of 100. Where the error sits between
# motor and link (`behind`), the motor is where its encoder says. What the camera alone sees (`seen`) moves no mass: a tip that
# drifts behind the last link.
@dataclass(frozen=True, slots=True)
class MotorAhead:
    """What the motor's angle, speed and acceleration have beyond what its encoder says, (m, n) or 0."""

    angle_rad: Array | float
    speed_rad_s: Array | float
    acceleration_rad_s2: Array | float


STILL: Final = MotorAhead(0.0, 0.0, 0.0)


def joint_ahead(terms: Sequence[Law], q: Array, t_s: Array) -> Array:
    """How much further than their encoders say the joints have turned, (m, n)."""
    ahead = np.zeros_like(q)
    for term in terms:
        j, by = place(term)
        ahead[:, j] += _turned(term, q[:, by], t_s)[0]
    return ahead


def motor_ahead(terms: Sequence[Law], q: Array, t_s: Array) -> Array:
    """How much further than their encoders say the motors have turned, in joint angles, (m, n)."""
    return joint_ahead([term for term in terms if _is_of_motor(term)], q, t_s)


def _is_of_motor(term: Law) -> bool:
    return term.form.where == "encoder" and not term.form.is_by_time


def angle_error(terms: Sequence[Law], run: Moving) -> tuple[MotorAhead, tuple[Array, Array, Array]]:
    """What the motors do beyond their encoders, and the links' angles, speeds and accelerations."""
    q, speed, acceleration = np.array(run.q), np.array(run.speed), np.array(run.acceleration)
    motor = np.zeros((3, *q.shape))
    for term in terms:
        if term.form.where == "seen":
            continue
        j, by = place(term)
        v, a = run.speed[:, by], run.acceleration[:, by]
        turned, slope, bend = _turned(term, run.q[:, by], run.t_s)
        is_by_time = term.form.is_by_time
        faster = np.asarray(slope if is_by_time else slope * v)
        pushed = np.asarray(bend if is_by_time else slope * a + bend * v * v)
        q[:, j] += turned
        speed[:, j] += faster
        acceleration[:, j] += pushed
        if _is_of_motor(term):
            motor[:, :, j] += turned, faster, pushed
    return MotorAhead(*motor), (q, speed, acceleration)


def place(term: Law) -> tuple[int, int]:
    """The joint (0-based) that is elsewhere, and the one whose angle says how far."""
    name = term.name
    moved, followed = moved_joint(name.effect, name.joint), followed_joint(name.effect, name.joint)
    return (moved or 0) - 1, (followed or 0) - 1


def _turned(term: Law, q: Array, t_s: Array) -> tuple[Array, Array, Array]:
    """The error and its first and second derivative by the angle, by time for a drift."""
    if term.form.angle is None:
        raise ValueError(f"{term.form} is no error of an angle")
    return term.form.angle(term.values, q, t_s)
