"""A straight line in time through the geometry of several calibrations, each with its own uncertainty.

Few DH parameters are determined by themselves, and which combinations are depends on the parameters. So geometry is compared
where it shows, at the tip: each calibration's tips at fixed poses over the workspace, by the full kinematics, relative to the
last one's. Their coordinates c are along what parameters can change there (left singular vectors of the tips' derivatives), so
that |c|^2 / poses is the mean square at the tip. Then c(t) = start + rate t, by generalised least squares; a step on a given day
is fitted in the same way, with its change in the place of the rate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.ageing.history import Entry, Geometry
from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.parameters import dh_names
from calib.arrays import Array
from calib.design.candidates import workspace_poses
from calib.identify.determinability import RANK_TOLERANCE
from control.model.arm import Arm

POSES: Final = 150
DRAWN: Final = 5  # poses over the joints' ranges for each one that is used
KNOWN: Final = 1e-10  # of the largest eigenvalue of an information matrix, below which nothing is known


@dataclass(frozen=True, slots=True)
class Line:
    """Coordinates (r,) [m sqrt(poses)]: start at the last calibration, and rate [1/day], or a step's change;
    covariance (2 r, 2 r) of both.

    scatter: how much more the calibrations scatter than they say, at least 1; freedom: degrees of freedom of that, 0 of two
    calibrations; chi_squared: of their scatter. toward (r, n): one radian of each joint's zero, halfway; NaN: not in the record.
    unseen: combinations of geometry that show at the tip and that the calibrations do not tell the drift of.
    """

    poses_count: int
    days: float
    count: int
    start: Array
    rate: Array
    covariance: Array
    scatter: float
    freedom: int
    chi_squared: float
    toward: Array
    zeros_rad: Array
    unseen: int

    @property
    def information(self) -> Array:
        """About the rate, whatever the start is, (r, r)."""
        size = len(self.rate)
        return np.asarray(np.linalg.pinv(self.covariance[size:, size:], rcond=KNOWN, hermitian=True))


def line_of(arm: Arm, entries: Sequence[Entry], step_day: float | None = None) -> Line | None:
    """Through all entries that have a geometry, or a step that the entries from that day on are behind; None with fewer than two
    days.
    """
    used = [(one.day, one.geometry) for one in entries if one.geometry is not None]
    if len({day for day, _ in used}) < 2:
        return None
    view = _View(arm, used[0][1], used[-1][1])
    days = np.array([day for day, _ in used]) - used[-1][0]
    seen = [view.seen(one) for _, one in used]
    span = float(-days.min())
    if step_day is None:
        passed, unit = days / span, span
    else:
        passed, unit = np.array([0.0 if day >= step_day else -1.0 for day, _ in used]), 1.0
    return _fitted(view, (passed, unit, span), [value for value, _ in seen], [info for _, info in seen])


class _View:
    """The coordinates of what geometry does at the tip, about the last calibration's."""

    def __init__(self, arm: Arm, first: Geometry, last: Geometry) -> None:
        self._arm, self._model = arm, ArmModel(arm)
        self._every = dh_names(len(arm.links))
        self._q = workspace_poses(arm, (), DRAWN * POSES)[:POSES]
        self.count = len(self._q)
        self._dh = self._table(last)
        slopes = self._model.slopes(self._dh, self._q)
        self._tips = slopes.tips
        places = [self._every.index(name) for name in last.names if name in self._every]
        scales = np.array(
            [scale for name, scale in zip(last.names, last.scales, strict=True) if name in self._every]
        )
        by_dh = slopes.by_dh.reshape(-1, len(self._every))
        left, singular, _ = np.linalg.svd(by_dh[:, places] * scales, full_matrices=False)
        self._basis = left[:, singular > RANK_TOLERANCE * singular[0]]
        thetas = list(self._model.theta_places)
        # Halfway between the first and the last, where a tangent is the chord of a large change.
        midway = self._model.slopes(0.5 * (self._table(first) + self._dh), self._q).by_dh
        self.toward = self._basis.T @ midway.reshape(-1, len(self._every))[:, thetas]
        self.toward[:, [self._every[place] not in last.names for place in thetas]] = np.nan
        self.zeros_rad = self._dh.ravel()[thetas]

    def seen(self, one: Geometry) -> tuple[Array, Array]:
        """A calibration's coordinates (r,) and their information (r, r)."""
        dh = self._table(one)
        slopes = self._model.slopes(dh, self._q)
        rows = [k for k, name in enumerate(one.names) if name in self._every]
        places = [self._every.index(one.names[k]) for k in rows]
        scales = np.array([one.scales[k] for k in rows])
        moves = self._basis.T @ slopes.by_dh.reshape(-1, len(self._every))[:, places] * scales
        lift = np.linalg.pinv(moves, rcond=RANK_TOLERANCE)
        information = lift.T @ _about(np.array(one.information), rows) @ lift
        return self._basis.T @ (slopes.tips - self._tips).ravel(), information

    def _table(self, one: Geometry) -> Array:
        """The DH table (links, 4); what the record lacks is as in arm.toml."""
        flat = self._arm.dh.ravel().copy()
        for name, value in zip(one.names, one.values, strict=True):
            if name in self._every:
                flat[self._every.index(name)] = value
        return flat.reshape(-1, 4)


def _about(information: Array, rows: list[int]) -> Array:
    """Information about some unknowns, whatever the others are (Schur complement)."""
    others = [k for k in range(len(information)) if k not in rows]
    own = information[np.ix_(rows, rows)]
    if not others:
        return own
    across = information[np.ix_(rows, others)]
    inverse = np.linalg.pinv(information[np.ix_(others, others)], rcond=KNOWN, hermitian=True)
    return np.asarray(own - across @ inverse @ across.T)


def _fitted(
    view: _View, time: tuple[Array, float, float], values: list[Array], informations: list[Array]
) -> Line:
    """`time`: what has passed until each calibration, -1 to 0; what the rate is per, in days; and the days of the record."""
    size, (passed, unit, span) = len(values[-1]), time
    normal, moment = np.zeros((2 * size, 2 * size)), np.zeros(2 * size)
    rows = [np.array([1.0, day]) for day in passed]
    for at, value, info in zip(rows, values, informations, strict=True):
        normal += np.kron(np.outer(at, at), info)
        moment += np.kron(at, info @ value)
    covariance: Array = np.asarray(np.linalg.pinv(normal, rcond=KNOWN, hermitian=True), dtype=np.float64)
    found = (covariance @ moment).reshape(2, size)
    left = [value - at @ found for at, value in zip(rows, values, strict=True)]
    chi_squared = sum(float(one @ info @ one) for one, info in zip(left, informations, strict=True))
    freedom = sum(_rank(info) for info in informations) - _rank(normal)
    scatter = math.sqrt(max(1.0, chi_squared / freedom)) if freedom else 1.0
    by_day = np.repeat([1.0, 1.0 / unit], size)
    of_both: Array = covariance * np.outer(by_day, by_day) * scatter**2
    return Line(
        poses_count=view.count,
        days=span,
        count=len(values),
        start=np.asarray(found[0]),
        rate=np.asarray(found[1] / unit),
        covariance=of_both,
        scatter=scatter,
        freedom=freedom,
        chi_squared=chi_squared,
        toward=view.toward,
        zeros_rad=view.zeros_rad,
        unseen=2 * size - _rank(normal),
    )


def _rank(information: Array) -> int:
    values = np.linalg.eigvalsh(information)
    return int((values > KNOWN * values.max()).sum())
