"""What the laws of effects act on: the arm as fitted so far, its loads, and the poses."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from calib.arrays import Array
from calib.gap.finding import EffectName, Parameters
from calib.gap.posterior.constants import SPEAKS_FOR, USUAL
from calib.gap.posterior.term import NO_TRAITS, Block, Term, Traits, on_joint, parameters_of
from calib.gap.residuals.scene import (
    Columns,
    Curve,
    OperatingPoint,
    Response,
    Responses,
    RowConditions,
    SeriesScene,
    SeriesTerm,
    Shape,
    departed,
    scaled,
    size_of,
    stacked,
)
from calib.gap.signals.terms import Form, Law, typical
from calib.points.points import Points
from control.dynamics.static_pose import RestingPose, gravity_Nm, resting
from control.errors import MissingModel
from control.model.arm import Arm
from control.model.effects import followed_joint, linear_values, moved_joint


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
        self, scene: PoseScene, joint: int | None, law: Array, departs: Sequence[Array] = (), nuisances: Sequence[Array] = ()
    ) -> Term:
        """The term of poses on the joint that the effect moves, from courses (m,) per unit of the coefficient: of the law, (m,)
        or (l, m), of how parts depart from it, and of what comes along.
        """
        poses, moved = in_poses(self), moved_joint(self.effect, joint) or 1
        laws, name = np.atleast_2d(law), EffectName(self.effect, joint)
        columns = poses.size * on_joint(np.array([*laws, *departs, *nuisances]), moved - 1, scene.points.joint_count)
        return Term(
            name,
            "",
            len(laws),
            len(departs),
            poses.size,
            slope_rad=columns,
            is_positive=poses.is_positive,
            parameters=parameters_of(self.effect),
            variable=poses.variable.format(j=joint),
            traits=self.traits,
        )


def in_poses(record: EffectRecord) -> InPoses:
    """What a record has of poses."""
    if record.poses is None:
        raise ValueError(f"{record.effect} is not looked for in poses")
    return record.poses


@dataclass(frozen=True, slots=True)
class Sought:
    """An effect on one joint or link as time series look for it: around a model, which may have it already (`identified`)."""

    point: OperatingPoint
    record: EffectRecord
    key: EffectName

    @property
    def series(self) -> InSeries:
        """What its record has of time series."""
        if self.record.series is None:
            raise ValueError(f"{self.record.effect} is not looked for in time series")
        return self.record.series

    @property
    def identified(self) -> Law | None:
        """The law as it was found before."""
        return self.point.laws.get(self.key)

    @property
    def forms(self) -> tuple[Form, ...]:
        """Those that are open: all of them, or that of the law that was found."""
        return self.series.forms if self.identified is None else (self.identified.form,)

    def size(self, form: Form) -> float:
        """The usual size of a law on its joint or link."""
        return self.series.usual * typical(self.point.scene.given_Nm, form, (self.key.joint or 0) - 1)


def harmonics(angle: Array, *orders: int) -> list[Array]:
    """Sine and cosine of each order."""
    return [f(order * angle) for order in orders for f in (np.sin, np.cos)]


# The ways in which a real part departs from its law: functions of its own variable, by which the law is multiplied.


def _unit(values: Array) -> Array:
    """Over the root mean square."""
    size = float(np.sqrt(np.mean(values**2)))
    return values / size if size > 0.0 else values


def by_angle(at: RowConditions, j: int) -> Array:
    """Two harmonics of the joint's turn, and what is slower over its travel."""
    q = at.q[:, j]
    return np.array([np.sin(q), np.cos(q), np.sin(2 * q), np.cos(2 * q)])


def by_speed(at: RowConditions, j: int) -> Array:
    """Its absolute value and its square."""
    v = _unit(at.speed[:, j])
    return np.array([np.abs(v), v**2])


def by_direction(at: RowConditions, j: int) -> Array:
    """One way and the other."""
    return at.direction[:, j][None]


def by_load(at: RowConditions, j: int) -> Array:
    """Of what the gear transmits: its absolute value, its root and its square."""
    load = np.abs(_unit(at.load_Nm[:, j]))
    return np.array([load, np.sqrt(load), load**2])


def by_current(at: RowConditions, j: int) -> Array:
    """Of the motor: its absolute value and its square."""
    i = _unit(at.current_A[:, j])
    return np.array([np.abs(i), i**2])


def by_currents(at: RowConditions, j: int) -> Array:
    """Of all motors together."""
    return _unit(np.sum(np.abs(at.current_A), axis=1))[None]


def departures(scene: SeriesScene, shapes: Sequence[Shape], joint: int, law: Response) -> tuple[dict[int, Columns], Array]:
    """Columns of a law's departures on a joint (0-based), each as large as the law; every channel for itself.

    With them what departures change that looks like the law itself, a part of each for every shape of a variable (`departed`), of
    the channel that shows the law best. A motor that saturates gives less torque, and its back-EMF is as before. What currents
    show of a gear is mostly how its angle changes, with the noise of that: where the tip shows the angle, it alone says how the
    gear departs.
    """
    if not shapes or not law:
        return {}, np.zeros((0, 1, 1))
    parts, alike, largest = [], np.zeros((0, 1, 1)), 0.0
    channels = list(dict.fromkeys(scene.cells[cell].channel for cell in law))
    for channel in channels:
        of_channel = {cell: columns for cell, columns in law.items() if scene.cells[cell].channel == channel}
        wanted = {cell: scene.shapes(shapes, joint, cell) for cell in of_channel}
        bent, projection = departed(of_channel, {cell: columns for cell, (columns, _) in wanted.items()})
        if bent:
            parts.append(bent)
        if (size := float(np.linalg.norm(size_of(of_channel)))) > largest:
            _, counts = next(iter(wanted.values()))
            alike, largest = projection / np.sqrt(np.repeat(counts, counts))[:, None, None], size
    return (stacked(parts) if parts else {}), alike


def filled(
    sought: Sought,
    term: SeriesTerm,
    laws: Response,
    nuisances: Sequence[Response] = (),
    more: Response | None = None,
    towards: tuple[float, float] | None = None,
) -> Iterator[SeriesTerm]:
    """A term with its columns, from its law's response per usual size; `more`: departures beside those of its variable.

    `towards`: the law's first value at which its response is a secant, and that at which the first nuisance has it.
    """
    if not laws:
        return
    series, joint = sought.series, (followed_joint(sought.key.effect, sought.key.joint) or 1) - 1
    bent, alike = departures(sought.point.scene, series.departs, joint, laws)
    departs: list[Responses] = [response for response in (bent, more) if response]
    count, bends = (sum(next(iter(response.values())).shape[1] for response in responses) for responses in ([laws], departs))
    now = term.now if term.now is None else np.insert(term.now, count, np.zeros(bends))
    yield dataclasses.replace(
        term,
        words=str(term.key),
        laws=count,
        departures=bends,
        variable=series.variable,
        traits=sought.record.traits,
        response=stacked([laws, *departs, *nuisances]),
        alike=alike,
        now=now,
        curve=None if towards is None else Curve(count + bends, *towards, term.size),
    )


def unlisted(term: SeriesTerm) -> SeriesTerm:
    """What is off the list is still in the world: the law as a block of its own."""
    key = term.key
    joint, effect = (key.joint or 0, key.effect) if isinstance(key, EffectName) else (key.joint, key.variable)
    words = f"{term.words} (left out of the list)"
    return dataclasses.replace(term, key=Block(joint, effect), words=words, law=None)


def known_law(record: EffectRecord, name: EffectName, parameters: Mapping[str, float]) -> Law | None:
    """The law of an `[[effect]]`; None for one that time series do not show."""
    series = record.series
    if series is None:
        return None
    if series.known is not None:
        return series.known(series, name, parameters)
    values = linear_values(name.effect, parameters)
    if not values:
        return None
    nought = (0.0,) * (series.form.count - len(values))
    return Law(name, series.form, (*values, *nought), parameters.get("order", 0.0))


def straight(sought: Sought) -> Iterator[SeriesTerm]:
    """Every form of a law that the rows follow in a straight line, or nearly so; later, the form that was found."""
    for form in sought.forms:
        yield from _straight(sought, form)


def _straight(sought: Sought, form: Form) -> Iterator[SeriesTerm]:
    point, key, identified, size = sought.point, sought.key, sought.identified, sought.size(form)
    count = form.count or 4 * len(point.scene.arm.links)
    law = Law(key, form, (0.0,) * count)
    base, at = point.without(key)
    start = law.values if identified is None else identified.values
    if count == 1 and start[0]:  # a secant from nought to what was found
        moved, steps = [law.at((start[0],))], [start[0]]
    else:
        steps = [0.3 * size] * count
        moved = [law.at((*law.values[:k], step, *law.values[k + 1 :])) for k, step in enumerate(steps)]
    columns = [(point.scene.columns.residual((*base, there)) - at) / step for there, step in zip(moved, steps, strict=True)]
    least = sought.series.least(point.scene.arm, law)
    term = SeriesTerm(
        key,
        size=size,
        law=lambda c: law.at(tuple((c[:count] * size).tolist())),
        is_positive=math.isfinite(least),
        least=max(least, -1e6) / size,
        now=None if identified is None else np.array(start) / size,
    )
    yield from filled(sought, term, scaled(point.scene.split(np.stack(columns, axis=1)), size))


FINER = (1.0, 1.2)  # times what was found, the next time: the second says how the first bends


@dataclass(frozen=True, slots=True)
class Bent:
    """A law that the rows follow in no straight line: starts of its first value; what the others are like, with the standard
    deviations to which that is known before any data, and how large they may be.
    """

    starts: tuple[float, ...]
    others: tuple[float, ...] = ()
    steps: tuple[float, ...] = ()
    upper: tuple[float, ...] = ()
    most: float = math.inf  # of the first value


def _stepped(values: tuple[float, ...], steps: Sequence[float]) -> list[tuple[float, ...]]:
    """Values, and the same with a step of each but the first."""
    one_more = [(*values[: k + 1], values[k + 1] + step, *values[k + 2 :]) for k, step in enumerate(steps)]
    return [values, *one_more]


def secants(sought: Sought, bent: Bent) -> Iterator[SeriesTerm]:
    """The secant from nought to each start, how the next start's differs from it, and what the other values' steps do.

    These are counted from what the others are like before any data, wherever the model of this linearisation has them: else each
    linearisation would add as much again to what is known of them.
    """
    point, identified, form = sought.point, sought.identified, sought.series.form
    rows, (base, at) = point.scene.columns, point.without(sought.key)
    first = bent.starts if identified is None else tuple(identified.values[0] * k for k in FINER)
    others = bent.others if identified is None else identified.values[1:]
    steps = tuple(
        step if value + step <= upper else -step for value, step, upper in zip(others, bent.steps, bent.upper, strict=True)
    )
    asked = [_stepped((v, *others), steps) for v in first]
    law, size = Law(sought.key, form, asked[0][0]), sought.size(form)
    if form.is_gear:
        rows.physics.following.foresee(base, [law.at(values) for group in asked for values in group])
    moved = [[rows.residual((*base, law.at(values))) for values in group] for group in asked]
    secants = [(rows_of[0] - at) * (size / v) for rows_of, v in zip(moved, first, strict=True)]
    for k, value in enumerate(first if identified is None else first[:1]):
        near = k + 1 if k + 1 < len(first) else k - 1
        bends = secants[near] - secants[k]
        columns = [secants[k], bends * value / size, *(stepped - moved[k][0] for stepped in moved[k][1:])]
        parts = [point.scene.split(column[:, None]) for column in columns]
        parts[1:] = [part or scaled(parts[0], 0.0) for part in parts[1:]]
        reach = SPEAKS_FOR[0] * value, min(SPEAKS_FOR[1] * value, bent.most)

        def law_of(c: Array, reach: tuple[float, float] = reach) -> Law:
            more = np.array(bent.others) + np.array(steps) * c[len(c) - len(steps) :]
            return law.at((float(np.clip(c[0] * size, *reach)), *np.clip(more, 0.0, bent.upper).tolist()))

        now = None
        if identified is not None and math.isclose(identified.values[0], value):
            now = np.array([value / size, 0.0, *((np.array(others) - bent.others) / steps)])
        term = SeriesTerm(
            sought.key,
            size=size,
            law=law_of,
            variant=value,
            is_positive=True,
            least=reach[0] / size,
            most=reach[1] / size,
            now=now,
        )
        yield from filled(sought, term, parts[0], parts[1:], towards=(value, first[near]))


def shaped(sought: Sought, form: Form, value: float, within: float, columns: tuple[Response, Response]) -> Iterator[SeriesTerm]:
    """A law of a size and one other value, from its response there and how that changes as this value grows by a share `within`.

    The share is followed between 0.6 and 1.6 of the value.
    """
    key, identified, size, is_positive = sought.key, sought.identified, sought.size(form), form.lower[0] == 0.0

    def law_of(c: Array) -> Law:
        own_size = max(float(c[0]), 0.0) if is_positive else float(c[0])
        share = within * float(c[-1]) / own_size if own_size else 0.0
        return Law(key, form, (float(c[0]) * size, value * float(np.clip(1.0 + share, 0.6, 1.6))))

    is_there = identified is not None and abs(value / identified.values[1] - 1.0) < 1e-9
    now = np.array([identified.values[0] / size]) if identified is not None and is_there else None
    term = SeriesTerm(key, size=size, law=law_of, variant=value, is_positive=is_positive, now=now)
    yield from filled(sought, term, columns[0], [columns[1]])
