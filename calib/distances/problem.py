"""Readings of lengths and, if there are any, measured tips, as one problem for the solver, in scaled unknowns.

Unknowns: those of the measured tips (or DH and tool without any), then those of the devices. A length is one number: three of
them make one row, so that all rows have three numbers. Each counts by its own noise, against that of a coordinate of a tip.
"""

from __future__ import annotations

import copy
from collections.abc import Collection

import numpy as np

from calib.arm_problem.added_rows import WithRows, in_threes
from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.expansion import ALL, Problem
from calib.arm_problem.parameters import Bounds, Parameter, dh_names, dh_parameters, require_known_names
from calib.arm_problem.problem import TOOL_NAMES
from calib.arrays import Array, frozen
from calib.distances.devices import Device
from calib.distances.readings import Readings, Rows

RANK = 1e-9  # of singular values
LEAST_SHARE = 0.05  # of a reading that does not place its own device


class DistanceProblem:
    """Meets Problem."""

    def __init__(
        self,
        model: ArmModel,
        readings: Readings,
        devices: tuple[Device, ...],
        inner: Problem | None = None,
        *,
        unit_m: float,
        tool_m: Array,
        is_tool_free: bool = False,
        bounds: Bounds | None = None,
        fixed: Collection[str] = (),
    ) -> None:
        """inner: the problem of measured tips, if there are any; unit_m: noise of a coordinate of its rows.

        tool_m (3,): start of the tool. CalibrationError for an unknown name in `fixed`, which holds where inner is None.
        """
        self.model, self.readings, self.devices, self._inner = model, readings, devices, inner
        self._unit_m, self._tool_m = unit_m, frozen(tool_m)
        own = _of_the_arm(model, bounds or Bounds(), is_tool_free, tool_m)
        of_devices = [parameter for device in devices for parameter in device.parameters]
        require_known_names(() if inner is not None else fixed, [p.name for p in own])
        left = inner.parameters if inner is not None else tuple(p for p in own if p.name not in fixed)
        self._count = len(left)
        self.parameters = (*left, *of_devices)
        self._scale = np.array([p.scale for p in self.parameters])
        places = {name: k for k, name in enumerate((*dh_names(len(model.nominal_dh)), *TOOL_NAMES))}
        self._whole = len(places) + len(of_devices)
        self._devices_at = len(places)
        known = [(k, places[p.name]) for k, p in enumerate(left) if p.name in places]
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
        some = copy.copy(self)
        some.readings, some._weight = self.readings.chosen(rows), self._weight[rows]
        some._rows = [some.readings.of(device.name) for device in self.devices]
        return some

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
        tips, found = self.model.tips(dh, self.readings.q_rad, tool), np.zeros((len(self.readings), 3))
        for device, rows, values in zip(self.devices, self._rows, self.device_values(x), strict=True):
            first, second = self.readings.pose[rows].T
            found[rows] = device.modelled(values, tips[first], tips[second])[1]
        return found

    def device_values(self, x: Array) -> list[Array]:
        """Deviations of each device's unknowns, in its own order."""
        whole, found, at = self._spread(x), [], self._devices_at
        for device in self.devices:
            found.append(whole[at : at + len(device.parameters)])
            at += len(device.parameters)
        return found

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
            length, by_first, by_second, own = device.modelled(
                values, slopes.tips[first], slopes.tips[second]
            )
            error[rows] = self.readings.length_m[rows] - length
            by_whole[rows, : self._devices_at] = -np.einsum("ri,rik->rk", by_first, by_arm[first])
            by_whole[rows, : self._devices_at] -= np.einsum("ri,rik->rk", by_second, by_arm[second])
            by_whole[rows, at : at + own.shape[1]] = -own
            at += own.shape[1]
        return error, by_whole

    def _widened(self, columns: Array) -> Array:
        """With columns of zeros for the devices."""
        whole = np.zeros((*columns.shape[:2], len(self.parameters)))
        whole[:, :, : self._count] = columns
        return whole


def _of_the_arm(model: ArmModel, bounds: Bounds, is_tool_free: bool, tool_m: Array) -> tuple[Parameter, ...]:
    found = list(dh_parameters(model.nominal_dh, bounds))
    if is_tool_free:
        found += [
            Parameter(name, "m", float(value), bounds.of_free(name, "m"))
            for name, value in zip(TOOL_NAMES, tool_m, strict=True)
        ]
    return tuple(found)
