"""Readings of lengths as one problem for the solver: draw wires, dial gauges, ball bars, distances between
poses.

In: points.csv with the columns `distance_of`, `distance_m` and perhaps `distance_sd_m`, and tips, if there
are any. Out: residuals and derivatives in the arm's parameters and the devices' places, which are unknowns,
too.

"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calib.arm_problem.arm_model import ArmModel, Parameter, dh_names
from calib.arm_problem.expansion import ALL, Problem
from calib.arm_problem.joint_effects import known_corrections
from calib.arm_problem.posed import WithRows, in_threes
from calib.arm_problem.problem import TOOL_NAMES
from calib.arrays import Array, frozen, norms
from calib.errors import PointsFileError, UnusablePointsError
from calib.points.points import Points, beyond, require_radians
from control.model.arm import Arm
from control.tables import TableColumn, TableContent, TableFormat

# Readings of lengths in a points.csv: columns `distance_of`, `distance_m` and, optionally, `distance_sd_m`.
#
# wire:NAME distance_m from a fixed point of unknown place to the tip: a draw wire, or a ball bar of known
# length gauge:NAME distance_m by which the tip is displaced along a fixed unknown direction, from an
# unknown zero: a dial gauge between:NAME distance_m between the tips of the two poses of this name


OF, LENGTH, SD = "distance_of", "distance_m", "distance_sd_m"
WIRE, GAUGE, BETWEEN = KINDS = ("wire", "gauge", "between")
LONGEST_m = 20.0
DEVICE = "wire:NAME, gauge:NAME or between:NAME"
LENGTHS = TableFormat(
    "point",
    (
        TableColumn(OF, "what measured", is_required=True, is_name=True, may_be_empty=True),
        TableColumn(
            LENGTH,
            "the length",
            is_required=True,
            may_be_empty=True,
            lower=-LONGEST_m,
            upper=LONGEST_m,
            expected=f"a length within +-{LONGEST_m:g} m",
        ),
        TableColumn(
            SD,
            "its standard deviation; empty: not stated",
            lower=math.ulp(0.0),
            upper=1.0,
            expected="a number above 0, up to 1 m",
        ),
    ),
)
Rows = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Readings:
    """r readings: device (kind:name) and pose of each, measured length_m (r,), sd_m (r,), NaN where not stated.

    q_rad (m, n): joint angles of all poses, with the arm's known static effects. pose (r, 2): the pose; of `between` both, else
    twice the same. name: setup:point:repeat of the (first) pose.
    """

    device: tuple[str, ...]
    name: tuple[str, ...]
    pose: Rows
    q_rad: Array
    length_m: Array
    sd_m: Array

    def __len__(self) -> int:
        """How many."""
        return len(self.device)

    def of(self, device: str) -> Rows:
        """The readings of a device."""
        return np.flatnonzero(np.array(self.device) == device)

    def chosen(self, rows: Sequence[int] | Rows) -> Readings:
        """Some of the readings."""
        keep = np.asarray(rows, dtype=np.intp)
        return Readings(
            tuple(self.device[k] for k in keep),
            tuple(self.name[k] for k in keep),
            self.pose[keep],
            self.q_rad,
            frozen(self.length_m[keep]),
            frozen(self.sd_m[keep]),
        )


def has_readings(points: Points) -> bool:
    """Whether the file holds lengths."""
    return any(text for text in points.extra.get(OF, ()))


def readings_of(arm: Arm, points: Points, where: Path) -> Readings:
    """The readings of a file. PointsFileError or UnusablePointsError names line and column."""
    table = beyond(points, where, LENGTHS, PointsFileError)
    require_radians(points.q_rad, f"{where}: ")
    devices, length_m = table.words(OF), table.number(LENGTH)
    rows = [k for k, text in enumerate(devices) if text]
    if not rows:
        raise PointsFileError(f"{where}, column {OF}: every cell is empty: expected {DEVICE}")
    for row in rows:
        kind, colon, name = devices[row].partition(":")
        if kind not in KINDS or not colon or not name.strip():
            raise table.bad_cell(row, OF, devices[row], DEVICE)
        if math.isnan(length_m[row]):
            raise table.bad_cell(row, LENGTH, "", f"a length within +-{LONGEST_m:g} m")
    poses = _poses(table, devices, length_m, rows)
    firsts = [first for first, _ in poses]
    names = [":".join((points.setup[k], points.point[k], str(points.repeat[k]))) for k in firsts]
    return Readings(
        tuple(devices[k] for k in firsts),
        tuple(names),
        np.array(poses, dtype=np.intp),
        frozen(points.q_rad + known_corrections(arm, points)),
        frozen(length_m[firsts]),
        frozen(table.number(SD)[firsts]),
    )


def _poses(table: TableContent, devices: Sequence[str], length_m: Array, rows: Sequence[int]) -> list[tuple[int, int]]:
    """Both poses of each reading; the first states it."""
    poses, open_pairs = [], dict[str, int]()
    for row in rows:
        device = devices[row]
        if not device.startswith(BETWEEN):
            poses.append((row, row))
        elif device in open_pairs:
            first = open_pairs.pop(device)
            if length_m[first] != length_m[row]:
                raise PointsFileError(
                    f"{table.path}, lines {table.lines[first]} and {table.lines[row]}, column {LENGTH}: got"
                    f" {length_m[first]:g} and {length_m[row]:g} m, expected the same distance in both lines of a pair"
                )
            poses.append((first, row))
        else:
            open_pairs[device] = row
    if open_pairs:
        device, row = next(iter(open_pairs.items()))
        raise PointsFileError(f'{table.place(row)}: "{device}" has no second pose: expected two lines with this name')
    return poses


# The devices of readings, as unknowns: a wire's fixed point, a gauge's direction and zero.
#
#     wire      length = zero + |p - a|           a unknown; zero 0, or unknown
#     gauge     length = zero + n . p             n = (n0 + t1 e1 + t2 e2) / |..|, t and zero unknown
#     between   length = |p1 - p2|                nothing unknown
#
# p is the tip. Starts are closed forms at the nominal geometry (trilateration; a regression of the readings
# on the tips).


LEAST = {WIRE: 4, GAUGE: 4, BETWEEN: 1}  # readings; a wire with an unknown zero needs one more
STEPS = 50
Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Device:
    """One device: its unknowns begin at `parameters`; place (3,): a wire's start, or a gauge's direction n0.

    axes (2, 3): e1 and e2 of a gauge; zero_m: the start of its zero; is_known: whether a wire's place is stated.
    """

    name: str
    kind: str
    parameters: tuple[Parameter, ...]
    place: Array
    axes: Array
    zero_m: float
    is_known: bool = False

    def at(self, values: Array) -> tuple[Array, float]:
        """Fixed point of a wire or direction of a gauge, and the zero, at deviations (k,) of the parameters."""
        if self.kind == WIRE:
            moved, zero = (np.zeros(3), values) if self.is_known else (values[:3], values[3:])
            return self.place + moved, self.zero_m + float(zero.sum())
        if self.kind == GAUGE:
            raw = self.place + values[:2] @ self.axes
            return raw / np.linalg.norm(raw), self.zero_m + float(values[2])
        return self.place, 0.0

    def modelled(self, values: Array, first: Array, second: Array) -> tuple[Array, Array, Array, Array]:
        """Lengths (r,), their derivatives by both tips (r, 3), and by the parameters (r, k)."""
        place, zero_m = self.at(values)
        if self.kind == GAUGE:
            return self._by_gauge(values, first, place, zero_m)
        way = first - (place if self.kind == WIRE else second)
        length = norms(way)
        along = way / np.maximum(length, 1e-12)[:, None]
        by_device = np.zeros((len(first), len(self.parameters)))
        if self.kind == WIRE:
            if not self.is_known:
                by_device[:, :3] = -along
            by_device[:, 0 if self.is_known else 3 :] = 1.0
        return zero_m + length, along, -along if self.kind == BETWEEN else np.zeros_like(along), by_device

    def _by_gauge(self, values: Array, tips: Array, along: Array, zero_m: float) -> tuple[Array, Array, Array, Array]:
        size = float(np.linalg.norm(self.place + values[:2] @ self.axes))
        turns = (self.axes - np.outer(self.axes @ along, along)) / size
        own = np.column_stack((tips @ turns.T, np.ones(len(tips))))
        return zero_m + tips @ along, np.tile(along, (len(tips), 1)), np.zeros_like(tips), own


@dataclass(frozen=True, slots=True)
class WireKnowledge:
    """Whether a wire's zero is unknown, too; fixed points that are known in the base frame, by the wires' names."""

    free_zero: bool = False
    known_m: Mapping[str, Vector] = field(default_factory=dict)


def devices_of(readings: Readings, tips: Array, wires: WireKnowledge, to_spare: int = 0) -> tuple[Device, ...]:
    """All devices, at their starts by the nominal tips (m, 3). UnusablePointsError for too few readings of one.

    to_spare: readings beyond those that place a device.
    """
    names = list(dict.fromkeys(readings.device))
    for wire in wires.known_m:
        if f"{WIRE}:{wire}" not in names:
            there = ", ".join(name.partition(":")[2] for name in names if name.startswith(WIRE)) or "none"
            raise UnusablePointsError(f'no wire "{wire}" in the readings: expected one of {there}')
    return tuple(_device(name, readings, tips, wires, to_spare) for name in names)


def _device(name: str, readings: Readings, tips: Array, wires: WireKnowledge, to_spare: int) -> Device:
    rows, (kind, _, label) = readings.of(name), name.partition(":")
    free_zero, is_known = wires.free_zero, kind == WIRE and label in wires.known_m
    least = 1 if is_known or kind == BETWEEN else LEAST[kind] + (kind == WIRE and free_zero) + to_spare
    if len(rows) < least:
        raise UnusablePointsError(f'"{name}": {len(rows)} readings, {least} are needed to find where it stands')
    at, length = tips[readings.pose[rows, 0]], readings.length_m[rows]
    axes, zero_m, place = np.zeros((0, 3)), 0.0, np.zeros(3)
    units: tuple[tuple[str, str], ...] = (("zero", "m"),) if kind == WIRE and free_zero else ()
    if is_known:
        place = np.array(wires.known_m[label])
        zero_m = float(np.mean(length - norms(at - place))) if free_zero else 0.0
    elif kind == WIRE:
        place, zero_m = _fixed_point(at, length, free_zero)
        units = (("x", "m"), ("y", "m"), ("z", "m"), *units)
    elif kind == GAUGE:
        place, zero_m = _direction(name, at, length)
        axes = np.linalg.svd(place[None])[2][1:]
        units = (("tilt1", "rad"), ("tilt2", "rad"), ("zero", "m"))
    called = name.replace(":", "_")
    parameters = tuple(Parameter(f"{called}_{what}", unit, 0.0, math.inf) for what, unit in units)
    return Device(name, kind, parameters, frozen(place), frozen(axes), zero_m, is_known)


def _direction(name: str, tips: Array, length: Array) -> tuple[Array, float]:
    """Unit direction and zero whose readings fit the tips best."""
    centre = tips.mean(axis=0)
    slope, *_ = np.linalg.lstsq(tips - centre, length - length.mean(), rcond=1e-2)
    size = float(np.linalg.norm(slope))
    if size < 1e-9:
        raise UnusablePointsError(f'"{name}": its readings do not change with the tip: no direction follows from them')
    direction = slope / size
    return direction, float(np.mean(length - tips @ direction))


def _fixed_point(tips: Array, length: Array, free_zero: bool) -> tuple[Array, float]:
    """Where a wire's fixed point is, and its zero: trilateration, then Gauss-Newton; on both sides of the tips' plane.

    2 p . a - c = p . p - l^2 with c = a . a (- zero^2) is linear in a and c; with an unknown zero also 2 l zero.
    """
    columns = [2.0 * tips, -np.ones((len(tips), 1))] + ([2.0 * length[:, None]] if free_zero else [])
    linear, *_ = np.linalg.lstsq(np.hstack(columns), np.sum(tips**2, axis=1) - length**2, rcond=1e-6)
    first, zero = linear[:3], float(-linear[4]) if free_zero else 0.0
    centre = tips.mean(axis=0)
    normal = np.linalg.svd(tips - centre)[2][2]
    away = float(length.mean())
    starts = [first, first - 2.0 * ((first - centre) @ normal) * normal]
    starts += [centre + side * away * axis for axis in np.eye(3) for side in (1.0, -1.0)]
    found = [_refined(tips, length, start, zero, free_zero) for start in starts]
    _, place, zero_m = min(found, key=lambda one: one[0])
    return place, zero_m


def _refined(tips: Array, length: Array, start: Array, zero: float, free_zero: bool) -> tuple[float, Array, float]:
    """Sum of squares, place and zero after damped Gauss-Newton steps from a start."""
    x = np.append(start, zero) if free_zero else np.array(start)
    damping, best = 1e-3, math.inf

    def residuals(at: Array) -> Array:
        return np.asarray(length - (at[3] if free_zero else 0.0) - norms(tips - at[:3]))

    error = residuals(x)
    best = float(error @ error)
    for _ in range(STEPS):
        way = tips - x[:3]
        slope = -way / np.maximum(norms(way), 1e-9)[:, None]
        if free_zero:
            slope = np.column_stack((slope, np.ones(len(tips))))
        normal = slope.T @ slope
        step = np.linalg.solve(normal + damping * np.eye(len(x)), slope.T @ error)
        moved = residuals(x + step)
        value = float(moved @ moved)
        if value < best:
            x, error, best, damping = x + step, moved, value, 0.1 * damping
        else:
            damping *= 10.0
    return best, x[:3], float(x[3]) if free_zero else 0.0


# Readings of lengths and, if there are any, measured tips, as one problem for the solver, in scaled
# unknowns.
#
# Unknowns: those of the measured tips (or DH and tool without any), then those of the devices. A length is
# one number: three of them make one row, so that all rows have three numbers. Each counts by its own noise,
# against that of a coordinate of a tip.


RANK = 1e-9  # of singular values
LEAST_SHARE = 0.05  # of a reading that does not place its own device


class DistanceProblem:
    """Meets Problem."""

    def __init__(
        self,
        model: ArmModel,
        readings: Readings,
        devices: tuple[Device, ...],
        free: Sequence[Parameter],
        *,
        unit_m: float,
        tool_m: Array,
        inner: Problem | None = None,
    ) -> None:
        """free: what is identified besides the devices; inner: the problem of measured tips, if there are any, with the same.

        unit_m: noise of a coordinate of its rows; tool_m (3,): start of the tool.
        """
        self.model, self.readings, self.devices, self._inner = model, readings, devices, inner
        self._tool_m = frozen(tool_m)
        of_devices = [parameter for device in devices for parameter in device.parameters]
        self._count = len(free)
        self.parameters = (*free, *of_devices)
        self._scale = np.array([p.scale for p in self.parameters])
        places = {name: k for k, name in enumerate((*dh_names(len(model.nominal_dh)), *TOOL_NAMES))}
        self._whole = len(places) + len(of_devices)
        self._devices_at = len(places)
        known = [(k, places[p.name]) for k, p in enumerate(free) if p.name in places]
        known += [(self._count + k, self._devices_at + k) for k in range(len(of_devices))]
        self._from, self._to = np.array(known, dtype=np.intp).reshape(-1, 2).T
        self._rows = [readings.of(device.name) for device in devices]
        sd = np.where(np.isnan(readings.sd_m), unit_m, readings.sd_m)
        self._weight = unit_m / sd

    def __len__(self) -> int:
        """How many rows of three residuals."""
        tips = 0 if self._inner is None else len(self._inner)
        return tips + -(-len(self.readings) // 3)

    def of_readings(self, rows: Rows) -> DistanceProblem:
        """The problem with the same unknowns for some of the readings."""
        part = copy.copy(self)
        part.readings, part._weight = self.readings.chosen(rows), self._weight[rows]
        part._rows = [part.readings.of(device.name) for device in self.devices]
        return part

    def errors_m(self, x: Array) -> Array:
        """Measured minus modelled lengths, (r,)."""
        return self._lengths(x)[0]

    def left_out_m(self, x: Array) -> Array:
        """Errors (r,) of each reading with the unknowns that the others give, by first derivatives: e / (1 - leverage)."""
        error, by_whole = self._lengths(x)
        slopes = self._weight[:, None] * by_whole[:, self._to] * self._scale[self._from]
        left, sizes, _ = np.linalg.svd(slopes, full_matrices=False)
        leverage = (left[:, sizes > RANK * max(1e-300, sizes.max(initial=0.0))] ** 2).sum(axis=1)
        return np.asarray(error / np.maximum(1.0 - leverage, LEAST_SHARE))

    def along(self, x: Array) -> Array:
        """Unit vectors (r, 3) along which each length grows with its (first) tip."""
        dh, tool = self.arm_at(x)
        tips, directions = self.model.tips(dh, self.readings.q_rad, tool), np.zeros((len(self.readings), 3))
        for device, rows, values in zip(self.devices, self._rows, self.device_values(x), strict=True):
            first, second = self.readings.pose[rows].T
            directions[rows] = device.modelled(values, tips[first], tips[second])[1]
        return directions

    def device_values(self, x: Array) -> list[Array]:
        """Deviations of each device's unknowns, in its own order."""
        whole, values, at = self._spread(x), [], self._devices_at
        for device in self.devices:
            values.append(whole[at : at + len(device.parameters)])
            at += len(device.parameters)
        return values

    def arm_at(self, x: Array) -> tuple[Array, Array]:
        """DH table (links, 4) and tool (3,)."""
        whole, size = self._spread(x), self.model.nominal_dh.size
        return self.model.nominal_dh + whole[:size].reshape(-1, 4), self._tool_m + whole[size : size + 3]

    def residuals(self, x: Array, rows: slice = ALL) -> Array:
        """(rows, 3) [m]."""
        added = in_threes(self._weight * self._lengths(x)[0])
        if self._inner is None:
            return added[rows]
        return np.concatenate((self._inner.residuals(x[: self._count]), added))[rows]

    def residuals_and_jacobian(self, x: Array, rows: slice = ALL) -> tuple[Array, Array]:
        """(rows, 3) and (rows, 3, k)."""
        added, slopes = self._added(x)
        if self._inner is not None:
            error, by_x = self._inner.residuals_and_jacobian(x[: self._count])
            added, slopes = np.concatenate((error, added)), np.concatenate((self._widened(by_x), slopes))
        return added[rows], slopes[rows]

    def expanded(self, x: Array, rows: slice = ALL) -> WithRows:
        """Around x; of a slice, by first derivatives only."""
        if rows != ALL or self._inner is None:
            return WithRows(None, 0, *self.residuals_and_jacobian(x, rows))
        return WithRows(self._inner.expanded(x[: self._count]), self._count, *self._added(x))

    def sensitivity(self, x: Array, rows: slice = ALL) -> Array:
        """The Jacobian (rows, 3, k) for zero residuals: that of a length does not depend on its residual."""
        slopes = self._added(x)[1]
        if self._inner is not None:
            slopes = np.concatenate((self._widened(self._inner.sensitivity(x[: self._count])), slopes))
        return slopes[rows]

    def _spread(self, x: Array) -> Array:
        """All deviations of DH, tool and devices, in their own units."""
        whole = np.zeros(self._whole)
        whole[self._to] = (x * self._scale)[self._from]
        return whole

    def _added(self, x: Array) -> tuple[Array, Array]:
        error, by_whole = self._lengths(x)
        slopes = np.zeros((len(error), len(self.parameters)))
        slopes[:, self._from] = by_whole[:, self._to] * self._scale[self._from]
        return in_threes(self._weight * error), in_threes(self._weight[:, None] * slopes)

    def _lengths(self, x: Array) -> tuple[Array, Array]:
        """Measured minus modelled (r,), and its derivatives (r, K) by all deviations."""
        dh, tool = self.arm_at(x)
        slopes = self.model.slopes(dh, self.readings.q_rad, tool)
        by_arm = np.concatenate((slopes.by_dh, slopes.by_tool), axis=2)
        error, by_whole = np.zeros(len(self.readings)), np.zeros((len(self.readings), self._whole))
        at = self._devices_at
        for device, rows, values in zip(self.devices, self._rows, self.device_values(x), strict=True):
            first, second = self.readings.pose[rows].T
            length, by_first, by_second, by_device = device.modelled(values, slopes.tips[first], slopes.tips[second])
            error[rows] = self.readings.length_m[rows] - length
            by_whole[rows, : self._devices_at] = -np.einsum("ri,rik->rk", by_first, by_arm[first])
            by_whole[rows, : self._devices_at] -= np.einsum("ri,rik->rk", by_second, by_arm[second])
            by_whole[rows, at : at + by_device.shape[1]] = -by_device
            at += by_device.shape[1]
        return error, by_whole

    def _widened(self, columns: Array) -> Array:
        """With columns of zeros for the devices."""
        whole = np.zeros((*columns.shape[:2], len(self.parameters)))
        whole[:, :, : self._count] = columns
        return whole
