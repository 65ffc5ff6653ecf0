"""What the laws of effects act on: the arm as fitted so far, its loads, and the poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calib.arrays import Array
from calib.gap.finding import EffectName, Parameters
from calib.gap.posterior.constants import USUAL
from calib.gap.posterior.term import NO_TRAITS, Term, Traits, on_joint, parameters_of
from calib.gap.residuals.scene import OperatingPoint, RowConditions
from calib.gap.residuals.term import SeriesTerm
from calib.gap.signals.terms import Form, Law, typical
from calib.points.points import Points
from control.dynamics.static_pose import RestingPose, gravity_Nm, resting
from control.errors import MissingModel
from control.model.arm import Arm
from control.model.effects import moved_joint


@dataclass(frozen=True, slots=True)
class PoseScene:
    """Poses of the arm at its fitted geometry under the loads found so far.

    `nominal`: the same geometry without those loads; `joint_rad` (m, n): the joints' angles, at which loads act, while
    encoders' errors follow those of the points; `pose`: what the gears transmit, None without masses.
    """

    nominal: Arm
    arm: Arm
    points: Points
    joint_rad: Array
    pose: RestingPose | None

    @classmethod
    def of(cls, nominal: Arm, arm: Arm, points: Points, joint_rad: Array) -> PoseScene:
        """With what the gears transmit, where the arm's file has masses and drives."""
        try:
            pose = resting(arm, joint_rad, points.direction, points.current_A, stated_kg(points))
        except MissingModel:
            pose = None
        return cls(nominal, arm, points, joint_rad, pose)

    @property
    def gravity_Nm(self) -> Array | None:
        """What holds the links, (m, n); None for an arm without masses."""
        return None if self.pose is None else self.pose.gravity_Nm


def stated_kg(points: Points) -> Array:
    """The payload that the data states, (m,); 0 where it is unknown."""
    return np.nan_to_num(points.payload_kg)


def load_of(arm: Arm, points: Points, joint_rad: Array | None = None) -> Array | None:
    """Gravity's torques (m, n) at joint angles (m, n), by default the encoders'; None for an arm without masses."""
    try:
        return gravity_Nm(arm, points.q_rad if joint_rad is None else joint_rad, stated_kg(points))
    except MissingModel:
        return None


NO_TORQUE_Nm = 1e-6  # rounding: below it a joint carries nothing
Shape = Callable[[RowConditions, int], Array]  # (c, rows), from what stands beside and the joint
Role = Literal["", "angle", "torque"]
Needs = Literal["motor", "angle", "tip", "electrical"]
Over = Literal["load", "speed", "angle", "current", "time", "motor"]


@dataclass(frozen=True, slots=True)
class InPoses:
    """How an effect is looked for in static poses."""

    size: float  # usual, of the law's coefficient
    terms: Callable[[EffectRecord, PoseScene], Iterator[Term]]  # on every joint or link, in every variant
    told_apart_by: str  # the recording that would settle whether it is there
    is_load: bool = False  # holding currents alone show it
    is_total: bool = True  # what the file has of it is left out of the model and looked for as a whole
    variable: str = ""  # by which a part departs from the law ("{j}": its joint)
    is_positive: bool = False  # there is no less than none of it


@dataclass(frozen=True, slots=True)
class InSeries:
    """How an effect is looked for in time series."""

    forms: tuple[Form, ...]  # that it may have; the first is that of arm.toml
    terms: Callable[[Sought], Iterator[SeriesTerm]]  # on one joint or link, in every variant
    needs: Needs  # currents or voltages; these or the tip; the tip; both currents and voltages
    usual: float = USUAL  # size, in smallest sizes worth a name
    departs: tuple[Shape, ...] = ()  # functions that a real part's law is multiplied by
    variable: str = ""  # of these, in a word
    blocks: tuple[str, ...] = ()  # of its joint, those that are functions of the law's own variables
    over: Over = "load"  # the axis of its picture
    is_common: bool = False  # every gear has it
    places: Callable[[Arm], Iterable[int | None]] = lambda arm: (None,)  # links; of joints it is all of them
    least: Callable[[Arm, Law], float] = lambda arm, law: -math.inf  # that a law's first value can be
    # the law of an `[[effect]]`, and the parameters of a law of an arm with the covariance of its values, where these are not
    # simply those of the effect's linear unknowns
    known: Callable[[InSeries, EffectName, Mapping[str, float]], Law | None] | None = None
    parameters: Callable[[Arm, Law, Array], Parameters] | None = None

    @property
    def form(self) -> Form:
        """The first of them."""
        return self.forms[0]


@dataclass(frozen=True, slots=True)
class EffectRecord:
    """All that the gap workflow knows of an effect."""

    effect: str
    poses: InPoses | None = None
    series: InSeries | None = None
    role: Role = ""  # a joint that is not where its encoder says, or that is hard to turn: mistaken for others of its role
    traits: Traits = NO_TRAITS
    needs_drives: bool = False  # no answer without the drives' electrical values

    def on_joint(
        self,
        scene: PoseScene,
        joint: int | None,
        law: Array,
        departs: Sequence[Array] = (),
        nuisances: Sequence[Array] = (),
    ) -> Term:
        """The term of poses on the joint that the effect moves, from courses (m,) per unit of the coefficient: of the law, (m,)
        or (l, m), of how parts depart from it, and of what comes along.
        """
        poses, moved = in_poses(self), moved_joint(self.effect, joint) or 1
        laws, name = np.atleast_2d(law), EffectName(self.effect, joint)
        columns = poses.size * on_joint(
            np.array([*laws, *departs, *nuisances]), moved - 1, scene.points.joint_count
        )
        return Term(
            name, "", len(laws), len(departs), poses.size, slope_rad=columns, is_positive=poses.is_positive,
            parameters=parameters_of(self.effect), variable=poses.variable.format(j=joint), traits=self.traits,
        )  # fmt: skip


def in_poses(record: EffectRecord) -> InPoses:
    """What a record has of poses."""
    if record.poses is None:
        raise ValueError(f"{record.effect} is not looked for in poses")
    return record.poses


@dataclass(frozen=True, slots=True)
class Sought:
    """An effect on one joint or link as time series look for it: around a model, which may have it already (`own`)."""

    around: OperatingPoint
    record: EffectRecord
    key: EffectName

    @property
    def series(self) -> InSeries:
        """What its record has of time series."""
        if self.record.series is None:
            raise ValueError(f"{self.record.effect} is not looked for in time series")
        return self.record.series

    @property
    def own(self) -> Law | None:
        """The law as it was found before."""
        return self.around.found.get(self.key)

    @property
    def forms(self) -> tuple[Form, ...]:
        """Those that are open: all of them, or that of the law that was found."""
        return self.series.forms if self.own is None else (self.own.form,)

    def size(self, form: Form) -> float:
        """The usual size of a law on its joint or link."""
        return self.series.usual * typical(self.around.scene.given_Nm, form, (self.key.joint or 0) - 1)


def harmonics(angle: Array, *orders: int) -> list[Array]:
    """Sine and cosine of each order."""
    return [f(order * angle) for order in orders for f in (np.sin, np.cos)]
