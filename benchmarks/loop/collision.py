"""The check of two arms against each other, in one cycle: poses to capsules, and the least gap; beside MuJoCo's distances.

Each pose is checked several times and the fastest counts: other programs on the machine only add time. The percentiles are
over poses.
"""

import math
import random
from time import perf_counter
from typing import Any

import mujoco
import numpy as np

from benchmarks.table import BenchRow, compared
from control.model.cell import Cell, load_cell
from control.safety.collision import ArmBody, Capsule, Capsules, least_gap, pairs_between

POSES, ROUNDS, SEED = 2000, 5, 1
LIMIT_us = 60.0
LEAST_RADIUS_m = 1e-5  # MuJoCo has no capsule without a radius
SAME_m = 1e-4


def rows() -> list[BenchRow]:
    """Return the measured rows. ValueError if MuJoCo finds other distances."""
    cell = load_cell("pair")
    one, other = (ArmBody(placed, cell.tool_length_m) for placed in cell.arms)
    pairs = pairs_between(one, other)
    source = random.Random(SEED)
    poses = [_drawn(cell, source) for _ in range(POSES)]
    peer = MuJoCo(len(one.names), len(other.names), pairs)
    checks, exact, theirs = ([math.inf] * POSES for _ in range(3))
    for _ in range(ROUNDS):
        for k, (p, q) in enumerate(poses):
            start = perf_counter()
            near = least_gap(one.at(p), other.at(q), pairs, cell.clearance_m)
            checks[k] = min(checks[k], perf_counter() - start)
            first, second = one.at(p), other.at(q)
            start = perf_counter()
            gap = least_gap(first, second, pairs, math.inf)
            exact[k] = min(exact[k], perf_counter() - start)
            peer.place(first, second)
            start = perf_counter()
            gap_m = peer.least_gap_m()
            theirs[k] = min(theirs[k], perf_counter() - start)
            if abs(gap_m - gap.gap_m) > SAME_m or (near.gap_m < cell.clearance_m and near != gap):
                raise ValueError(f"{p}, {q}: MuJoCo finds {gap_m:.6f} m, the product {gap.gap_m:.6f} m")
    p99_us = _percentile_us(checks, 99)
    check = f"check of two arms of 3 joints, {len(pairs)} pairs of capsules: 99th percentile over poses"
    gaps = f"the least gap of {len(pairs)} pairs, capsules given: "
    name = f"MuJoCo {mujoco.__version__}, mj_geomDistance"
    return [
        BenchRow(check, p99_us, "us", "the limit", LIMIT_us, p99_us / LIMIT_us, "under 60 us", p99_us < LIMIT_us),
        BenchRow("the same, median", _percentile_us(checks, 50), "us"),
        compared(f"{gaps}99th percentile", _percentile_us(exact, 99), "us", name, _percentile_us(theirs, 99), "", None),
        compared(f"{gaps}median", _percentile_us(exact, 50), "us", name, _percentile_us(theirs, 50), "", None),
    ]


def _drawn(cell: Cell, source: random.Random) -> list[tuple[float, ...]]:
    return [tuple(source.uniform(*limits) for limits in placed.arm.limits_rad) for placed in cell.arms]


def _percentile_us(times_s: list[float], share: float) -> float:
    return float(1e6 * np.percentile(times_s, share))


class MuJoCo:
    """The same capsules as geoms of a model without joints."""

    def __init__(self, ones: int, others: int, pairs: tuple[tuple[int, int], ...]) -> None:
        spec = mujoco.MjSpec()
        for _ in range(ones + others):
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[LEAST_RADIUS_m, 0.1, 0.0])
        self._model: Any = spec.compile()
        self._data: Any = mujoco.MjData(self._model)
        self._ends = np.zeros(6)
        self._pairs = [(i, ones + j) for i, j in pairs]

    def place(self, one: Capsules, other: Capsules) -> None:
        """Put the geoms where the capsules are."""
        for k, capsule in enumerate((*one, *other)):
            self._place(k, capsule)

    def least_gap_m(self) -> float:
        """The least distance of all pairs."""
        model, data, ends = self._model, self._data, self._ends
        return float(min(mujoco.mj_geomDistance(model, data, i, j, 10.0, ends) for i, j in self._pairs))

    def _place(self, k: int, capsule: Capsule) -> None:
        along = np.array([capsule.dx, capsule.dy, capsule.dz])
        length = float(np.linalg.norm(along))
        turn, rows = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(9)
        if length > 0.0:
            mujoco.mju_quatZ2Vec(turn, along / length)
        mujoco.mju_quat2Mat(rows, turn)
        self._data.geom_xpos[k] = np.array([capsule.x, capsule.y, capsule.z]) + 0.5 * along
        self._data.geom_xmat[k] = rows
        self._model.geom_size[k, :2] = max(capsule.radius_m, LEAST_RADIUS_m), 0.5 * length
        self._model.geom_rbound[k] = 0.5 * length + capsule.radius_m + LEAST_RADIUS_m
