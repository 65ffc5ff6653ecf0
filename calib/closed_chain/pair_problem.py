"""Two arms in contact as a problem: contacts.csv, and the residuals of both arms and of where the second one stands.

contacts.csv is a points.csv whose q1_rad ... are the joints of the first arm, then those of the second, without measured tips.
distance_m: between the tips, as of two balls that touch or a ball bar; 0 or empty: both are in one place.
joined: the name of a rigid join of both tools: both are in one place, and their orientation to each other is the same wherever
the name is; empty: they only touch.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calib.arm_problem.arm_model import ArmModel, Bounds, Parameter, dh_parameters, require_known_names
from calib.arm_problem.joint_effects import known_corrections
from calib.arm_problem.observations import Frame, cross_matrix, left_jacobian, mean_rotation, rotation_of
from calib.arm_problem.posed import in_threes, inverse_jacobians
from calib.arm_problem.problem import REACHABLE, SEATING_STEPS, SEATING_LIMIT_rad
from calib.arrays import Array, frozen, norms
from calib.errors import PointsFileError, UnusablePointsError
from calib.identify.objective import Huber, Objective
from calib.points.points import Points, beyond, make_points, read_points, require_radians
from calib.points.writer import DISTANCE, Key
from control.kinematics.chain import TipSlopes
from control.kinematics.rotation import logarithms
from control.model.arm import Arm
from control.tables import TableColumn, TableFormat

JOINED = "joined"
DISTANCE_MOST_m = 5.0
BESIDE = TableFormat(
    "point",
    (
        TableColumn(
            DISTANCE,
            "between the tips; empty: 0",
            lower=0.0,
            upper=DISTANCE_MOST_m,
            expected=f"a distance from 0 to {DISTANCE_MOST_m:g} m",
        ),
        TableColumn(JOINED, "name of a rigid join of both tools; empty: they touch", is_name=True),
    ),
)
"""Columns of contacts that points.csv has beside its own."""


@dataclass(frozen=True, slots=True)
class Contacts:
    """m contacts: joint angles (m, n1) and (m, n2) with each arm's known static effects, distances between the tips (m,).

    `joined`: the name of a join of both tools, which also keeps the orientation between them; "" where they only touch.
    """

    name: tuple[str, ...]
    setup: tuple[str, ...]
    first_rad: Array
    second_rad: Array
    distance_m: Array
    joined: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Without names, no tools are joined."""
        if not self.joined:
            object.__setattr__(self, "joined", ("",) * len(self.name))

    def __len__(self) -> int:
        """How many."""
        return len(self.name)

    @property
    def keys(self) -> tuple[Key, ...]:
        """Setup, point and repeat of each: contacts of a file are named by all three, planned ones by the point."""
        keys = []
        for name, setup in zip(self.name, self.setup, strict=True):
            rest = name.removeprefix(f"{setup}:")
            point, _, repeat = rest.rpartition(":")
            keys.append((setup, name, 1) if rest == name else (setup, point, int(repeat)))
        return tuple(keys)

    def chosen(self, rows: npt.ArrayLike) -> Contacts:
        """Some of them, by index."""
        keep = np.arange(len(self))[np.asarray(rows)]
        return Contacts(
            tuple(self.name[k] for k in keep),
            tuple(self.setup[k] for k in keep),
            frozen(self.first_rad[keep]),
            frozen(self.second_rad[keep]),
            frozen(self.distance_m[keep]),
            tuple(self.joined[k] for k in keep),
        )


def read_contacts(path: Path, arms: tuple[Arm, Arm]) -> tuple[Contacts, tuple[str, ...]]:
    """The contacts of a file, and warnings. PointsFileError or UnusablePointsError names file, line and column."""
    first, second = arms
    n = first.joint_count
    try:
        points, warnings = read_points(path, n + second.joint_count, BESIDE)
    except PointsFileError as error:
        raise PointsFileError(
            f"{error} (contacts: the {n} joints of {first.name}, then the {second.joint_count} of {second.name})"
        ) from None
    if np.isfinite(points.tip_m).any():
        raise UnusablePointsError(
            f"{path}: contacts have no measured tips: remove x_m, y_m, z_m, or calibrate each arm by itself"
        )
    require_radians(points.q_rad, f"{path}: ")
    table = beyond(points, path, BESIDE, PointsFileError)
    distance_m, joined = np.nan_to_num(table.number(DISTANCE)), tuple(table.words(JOINED))
    for row, name in enumerate(joined):
        if name and distance_m[row] > 0.0:
            raise PointsFileError(
                f"{table.place(row)}, column {JOINED}: joined tools {name!r} are in one place: expected {DISTANCE} 0 or"
                f" empty, got {distance_m[row]:g}"
            )
    names = zip(points.setup, points.point, points.repeat, strict=True)
    return Contacts(
        tuple(f"{setup}:{point}:{repeat}" for setup, point, repeat in names),
        points.setup,
        frozen(_joint_rad(first, points, slice(0, n))),
        frozen(_joint_rad(second, points, slice(n, None))),
        frozen(distance_m),
        joined,
    ), warnings


def contact_points(setup: Sequence[str], name: Sequence[str], q_rad: Array, distance_m: Sequence[float]) -> Points:
    """Contacts as the points of a file: q_rad (m, n1 + n2) as the encoders say."""
    extra = {DISTANCE: tuple(f"{distance:g}" for distance in distance_m)}
    nowhere = np.full((len(name), 3), np.nan)
    return make_points(setup, name, [1] * len(name), q_rad, nowhere, extra=extra)


def _joint_rad(arm: Arm, points: Points, columns: slice) -> Array:
    """Joint angles of one arm, with its known static effects."""
    q, m = points.q_rad[:, columns], len(points)
    own = make_points(points.setup, points.point, points.repeat, q, np.full((m, 3), np.nan), points.direction[:, columns])
    return np.asarray(q + known_corrections(arm, own))


# Residuals of two arms in contact, with exact first derivatives, in scaled unknowns.
#
#     u = a + s + exp([w]) R (p2 - c) - p1     from the first tip to the second, in the first arm's base frame
#     contact in one place: u;   contact at a distance d: |u| - d
#
# p1, p2: tips by each arm's own DH table and tool. R, a, c: the start of where the second base stands, and the centre of its
# tips; s and w are unknown. Contacts at a distance are one number each: three of them make one row, so that all rows have three
# numbers. Tools that are joined rigidly add a row of orientation a contact (`Joins`). Second derivatives are left out (Gauss-
# Newton): residuals are millimetres.


ALL = slice(None)
AXES = ("x", "y", "z")
BASE = "base"


@dataclass(frozen=True, slots=True)
class PairExpansion:
    """Residuals (r, 3) and their derivatives (r, 3, k)."""

    residuals: Array
    jacobian: Array

    def sums(self, pull: Array, bend: Array | None) -> tuple[Array, Array]:
        """Gradient (k,) and gram (k, k)."""
        rows = self.jacobian.reshape(-1, self.jacobian.shape[2])
        if bend is None:
            bent = self.jacobian
        elif bend.ndim == 2:
            bent = bend.T[:, :, None] * self.jacobian
        else:
            bent = np.einsum("ijr,rjk->rik", bend, self.jacobian)
        return rows.T @ pull.ravel(), rows.T @ bent.reshape(rows.shape)

    def curvature(self, pull: Array) -> Array:
        """Left out, (k, k)."""
        k = self.jacobian.shape[2]
        return np.zeros((k, k))


@dataclass(frozen=True, slots=True)
class PairPlan:
    """What to identify: `fixed` parameters by name such as left_theta4, arms whose tip is identified too; by which objective."""

    bounds: Bounds = field(default_factory=Bounds)
    fixed: Collection[str] = ()
    free_tools: Collection[str] = ()
    objective: Objective = field(default_factory=Huber)


class PairProblem:
    """Two arms and their contacts; unknowns are DH and tool of the first, of the second, and the second's base."""

    def __init__(self, arms: tuple[Arm, Arm], contacts: Contacts, base: Frame, plan: PairPlan | None = None) -> None:
        """`base`: start of the second base in the first."""
        self.arms, self.contacts, self.base = arms, contacts, base
        self.plan = plan = plan or PairPlan()
        self.models = (ArmModel(arms[0]), ArmModel(arms[1]))
        self.names = names_of(arms)
        tips = self.models[1].tips(arms[1].dh, contacts.second_rad)
        self._centre = tips.mean(axis=0) if len(tips) else np.zeros(3)
        self.joins = self._nominal_joins()
        everything = self._all_parameters(plan.bounds, plan.free_tools)
        known = [p.name for p in everything]
        require_known_names(plan.fixed, known)
        self._places = np.array([k for k, name in enumerate(known) if name not in plan.fixed], dtype=np.intp)
        self.parameters = tuple(everything[k] for k in self._places)
        self._scale = np.array([p.scale for p in self.parameters])
        self._whole = len(everything)
        self._sizes = [arm.dh.size + 3 * (name in plan.free_tools) for name, arm in zip(self.names, arms, strict=True)]
        self._near = np.flatnonzero(contacts.distance_m == 0.0)
        self._far = np.flatnonzero(contacts.distance_m > 0.0)

    def _all_parameters(self, bounds: Bounds, free_tools: Collection[str]) -> list[Parameter]:
        """Of the first arm, of the second, of where its base stands, and of each join."""
        of_arms = [p for name, arm in zip(self.names, self.arms, strict=True) for p in _of_arm(name, arm, bounds, free_tools)]
        base = [
            Parameter(f"{self.names[1]}_{BASE}_{kind}{axis}", unit, 0.0, math.inf)
            for kind, unit in (("", "m"), ("r", "rad"))
            for axis in AXES
        ]
        joins = [Parameter(f"join_{name}_r{axis}", "rad", 0.0, math.inf) for name in self.joins.names for axis in AXES]
        return [*of_arms, *base, *joins]

    def __len__(self) -> int:
        """How many rows of three residuals."""
        return len(self._near) + math.ceil(len(self._far) / 3) + len(self.joins)

    def residuals(self, x: Array, rows: slice = ALL) -> Array:
        """(rows, 3) [m]."""
        (one, two), move, _ = self._parts(x)
        ours = self.models[0].tips(one[0], self.contacts.first_rad, one[1])
        theirs = self.models[1].tips(two[0], self.contacts.second_rad, two[1])
        gap = self.base.moved(self._centre, move).to_base(theirs) - ours
        far = norms(gap[self._far]) - self.contacts.distance_m[self._far]
        return np.concatenate((gap[self._near], in_threes(far), LEVER_m * self.angles_rad(x)))[rows]

    def residuals_and_jacobian(self, x: Array, rows: slice = ALL, at_zero: bool = False) -> tuple[Array, Array]:
        """(rows, 3) and (rows, 3, k); `at_zero`: that of orientations as if they fitted."""
        gap, by_whole = self._gaps(x)
        by_x = by_whole[:, :, self._places] * self._scale
        length, along = _lengths(gap[self._far])
        far = length - self.contacts.distance_m[self._far]
        by_far = np.einsum("mi,mik->mk", along, by_x[self._far])
        angles, by_angle = self._turned(x, at_zero)
        error = np.concatenate((gap[self._near], in_threes(far), LEVER_m * angles))
        slopes = np.concatenate((by_x[self._near], in_threes(by_far), by_angle))
        return error[rows], slopes[rows]

    def expanded(self, x: Array, rows: slice = ALL) -> PairExpansion:
        """Around x."""
        return PairExpansion(*self.residuals_and_jacobian(x, rows))

    def sensitivity(self, x: Array, rows: slice = ALL) -> Array:
        """The Jacobian (rows, 3, k) with the second arm's joints turned until the contacts close.

        It shows what the contacts determine: open ones make a rotation of the first arm differ from one of the second base.
        """
        seated = copy.copy(self)
        joints = self._sizes[0] + np.array(self.models[1].theta_places)
        for _ in range(SEATING_STEPS):
            gap, slopes = seated._gaps(x)
            missing = seated.contacts.distance_m[:, None] * _lengths(gap)[1] - gap
            move = np.einsum("mnk,mk->mn", np.linalg.pinv(slopes[:, :, joints], rcond=REACHABLE), missing)
            move *= np.minimum(1.0, SEATING_LIMIT_rad / np.maximum(norms(move), 1e-300))[:, None]
            seated.contacts = dataclasses.replace(seated.contacts, second_rad=seated.contacts.second_rad + move)
        return seated.residuals_and_jacobian(x, rows, at_zero=True)[1]

    def errors_m(self, x: Array) -> Array:
        """How far each contact is from closing, (m,)."""
        length = norms(self._gaps(x)[0])
        return np.abs(length - self.contacts.distance_m)

    def of_contacts(self, x: Array) -> tuple[Array, Array]:
        """Residuals (m, 3) and their derivatives (m, 3, k) of each contact: three numbers, or one and zeros."""
        gap, by_whole = self._gaps(x)
        by_x = by_whole[:, :, self._places] * self._scale
        error, slopes, far = np.array(gap), np.array(by_x), self._far
        length, along = _lengths(gap[far])
        error[far], slopes[far] = 0.0, 0.0
        error[far, 0] = length - self.contacts.distance_m[far]
        slopes[far, 0] = np.einsum("mi,mik->mk", along, by_x[far])
        return error, slopes

    def solution(self, x: Array) -> tuple[tuple[Arm, Arm], Frame]:
        """Both arms, and where the second base stands in the first. Gravity of the second is that of the first, as it stands."""
        parts, move, _ = self._parts(x)
        first, second = (with_geometry(arm, dh, tool) for arm, (dh, tool) in zip(self.arms, parts, strict=True))
        base = self.base.moved(self._centre, move)
        down = tuple((base.rotation.T @ np.array(first.gravity_m_s2)).tolist())
        return (first, dataclasses.replace(second, gravity_m_s2=down)), base

    def angles_rad(self, x: Array) -> Array:
        """How far the orientation between joined tools is from that of their join, (r, 3)."""
        return self._turned(x, at_zero=True)[0] if len(self.joins) else np.zeros((0, 3))

    def _nominal_joins(self) -> Joins:
        contacts = self.contacts
        ours, theirs = (
            np.array(model.slopes(arm.dh, q_rad).by_tool)
            for model, arm, q_rad in zip(self.models, self.arms, (contacts.first_rad, contacts.second_rad), strict=True)
        )
        return Joins.of(contacts.joined, ours, self.base.rotation @ theirs)

    def _turned(self, x: Array, at_zero: bool) -> tuple[Array, Array]:
        """Angles (r, 3) between joined tools, and their Jacobian (r, 3, k) as lengths."""
        (first_arm, second_arm), move, turns = self._parts(x)
        joins, (first, second) = self.joins, self._sizes
        if not len(joins):
            return np.zeros((0, 3)), np.zeros((0, 3, len(self.parameters)))
        ours = self.models[0].slopes(first_arm[0], self.contacts.first_rad[joins.rows], first_arm[1])
        theirs = self.models[1].slopes(second_arm[0], self.contacts.second_rad[joins.rows], second_arm[1])
        turn = rotation_of(move[3:]) @ self.base.rotation
        errors = joins.errors(turns, ours.by_tool, turn @ theirs.by_tool)
        by_first, by_second = np.zeros((2, len(joins), 3, self._whole))
        by_first[:, :, : ours.by_dh.shape[2]] = turning(ours)
        joins.by_turn(turns, ours.by_tool, by_first[:, :, first + second + 6 :])
        by_second[:, :, first : first + theirs.by_dh.shape[2]] = turn @ turning(theirs)
        by_second[:, :, first + second + 3 : first + second + 6] = left_jacobian(move[3:])
        slopes = joins.slopes(errors, by_first, by_second, at_zero)
        return errors, slopes[:, :, self._places] * self._scale

    def _parts(self, x: Array) -> tuple[list[tuple[Array, Array]], Array, Array]:
        """DH table and tool of each arm, the base's move (6,), and each join's turn (j, 3)."""
        whole = np.zeros(self._whole)
        whole[self._places] = x * self._scale
        parts, start = [], 0
        for arm, model, size in zip(self.arms, self.models, self._sizes, strict=True):
            deviations = whole[start : start + size]
            tool = model.nominal_tool_m + (deviations[arm.dh.size :] if size > arm.dh.size else 0.0)
            parts.append((arm.dh + deviations[: arm.dh.size].reshape(-1, 4), tool))
            start += size
        return parts, whole[start : start + 6], whole[start + 6 :].reshape(-1, 3)

    def _gaps(self, x: Array) -> tuple[Array, Array]:
        """From the first to the second tip (m, 3), and its derivatives (m, 3, K) by every parameter in its own unit."""
        (one, two), move, _ = self._parts(x)
        ours = self.models[0].slopes(one[0], self.contacts.first_rad, one[1])
        theirs = self.models[1].slopes(two[0], self.contacts.second_rad, two[1])
        turn = rotation_of(move[3:]) @ self.base.rotation
        arms = (theirs.tips - self._centre) @ turn.T
        gap = self.base.to_base(self._centre) + move[:3] + arms - ours.tips
        slopes = np.zeros((len(gap), 3, self._whole))
        first, second = self._sizes
        slopes[:, :, :first] = -np.concatenate((ours.by_dh, ours.by_tool), axis=2)[:, :, :first]
        slopes[:, :, first : first + second] = (turn @ np.concatenate((theirs.by_dh, theirs.by_tool), axis=2))[:, :, :second]
        slopes[:, :, first + second : first + second + 3] = np.eye(3)
        turns = left_jacobian(move[3:])
        for axis in range(3):
            slopes[:, :, first + second + 3 + axis] = arms @ cross_matrix(turns[:, axis]).T
        return gap, slopes


def names_of(arms: tuple[Arm, Arm]) -> tuple[str, str]:
    """Names of the arms in parameters and files; first and second where they are the same."""
    one, two = arms[0].name, arms[1].name
    return (one, two) if one != two else ("first", "second")


def with_geometry(arm: Arm, dh: Array, tool_m: Array) -> Arm:
    """The arm with another DH table and tip."""
    x, y, z = tool_m.tolist()
    return dataclasses.replace(arm.with_dh(frozen(dh)), tool=dataclasses.replace(arm.tool, position_m=(x, y, z)))


def _of_arm(name: str, arm: Arm, bounds: Bounds, free_tools: Collection[str]) -> list[Parameter]:
    parameters = [dataclasses.replace(p, name=f"{name}_{p.name}") for p in dh_parameters(ArmModel(arm), bounds)]
    if name in free_tools:
        parameters += [
            Parameter(f"{name}_tool_{axis}", "m", value, math.inf) for axis, value in zip(AXES, arm.tool.position_m, strict=True)
        ]
    return parameters


def _lengths(vectors: Array) -> tuple[Array, Array]:
    """Lengths (m,) and directions (m, 3)."""
    length = norms(vectors)
    return length, vectors / np.maximum(length, 1e-12)[:, None]


# Tools that are joined rigidly: the orientation of the second in the first is the same at all contacts of one join.
#
#     e = lever log(R_base R_2 (R_1 exp([t]) R_0)'),   R_0: the join's start, t: its unknown turn
#     de = lever (J_l(e)^-1 w_2 - J_r(e)^-1 w_1)       (Barfoot, State Estimation for Robotics, 7.1)
#
# w: how the last links turn with the unknowns, in the base frame. A link's theta turns it about the axis along which its d moves
# the tip, its alpha about that of its L.
LEVER_m = 0.1  # makes an angle a length: 0.2 mm at a tip are 2 mrad between tools
D, THETA, L, ALPHA = range(4)  # of a DH row


@dataclass(frozen=True, slots=True)
class Joins:
    """The contacts `rows` (r,) of joined tools, which of the `names` each belongs to (r,), and each join's start (j, 3, 3)."""

    names: tuple[str, ...]
    rows: npt.NDArray[np.intp]
    which: npt.NDArray[np.intp]
    start: Array

    @classmethod
    def of(cls, joined: Sequence[str], first: Array, second: Array) -> Joins:
        """Of the names of all contacts ("": not joined), and the last links' rotations (m, 3, 3) by nominal arms."""
        names = tuple(sorted({name for name in joined if name}))
        rows = np.array([row for row, name in enumerate(joined) if name], dtype=np.intp)
        which = np.array([names.index(joined[row]) for row in rows], dtype=np.intp)
        apart = np.swapaxes(first[rows], 1, 2) @ second[rows]
        start = [mean_rotation(apart[which == k]) for k in range(len(names))]
        return cls(names, rows, which, np.array(start).reshape(-1, 3, 3))

    def __len__(self) -> int:
        """How many contacts."""
        return len(self.rows)

    def errors(self, turns: Array, first: Array, second: Array) -> Array:
        """Angles between the tools, against their join's (r, 3) [rad]; `turns` (j, 3), rotations (r, 3, 3) of the last links."""
        wanted = np.array([rotation_of(turn) for turn in turns]).reshape(-1, 3, 3) @ self.start
        return logarithms(second @ np.swapaxes(first @ wanted[self.which], 1, 2))

    def slopes(self, errors: Array, by_first: Array, by_second: Array, at_zero: bool) -> Array:
        """Derivatives (r, 3, k) of LEVER_m * errors, from how both links turn (r, 3, k); `at_zero`: as if the errors were 0."""
        if not at_zero:
            inverse = inverse_jacobians(errors)
            by_second = inverse @ by_second
            by_first = np.swapaxes(inverse, 1, 2) @ by_first  # J_r(e) = J_l(e)'
        return np.asarray(LEVER_m * (by_second - by_first))

    def by_turn(self, turns: Array, first: Array, out: Array) -> None:
        """Write how the first link turns with each join's t to `out` (r, 3, 3 j)."""
        for k, turn in enumerate(turns):
            mine = self.which == k
            out[mine, :, 3 * k : 3 * k + 3] = first[mine] @ left_jacobian(turn)


def turning(slopes: TipSlopes) -> Array:
    """How the last link turns with dh.ravel(), (m, 3, 4 links)."""
    turns = np.zeros(slopes.by_dh.shape)
    turns[:, :, THETA::4] = slopes.by_dh[:, :, D::4]
    turns[:, :, ALPHA::4] = slopes.by_dh[:, :, L::4]
    return turns
