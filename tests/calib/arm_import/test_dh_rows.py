"""DH rows from axes: both conventions, any arrangement of axes, any tip frame, checked by screws instead of DH."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib.arm_import.dh_rows import Axis, Row, dh_rows
from control.kinematics.chain import link_transforms
from control.model.arm import Convention

SAME_m = 1e-10
LARGEST_m = 25.0  # no row of an arm of a metre or two reaches further


def turned(axis: Axis, angle: float) -> np.ndarray:
    """Rodrigues' rotation about a line, (4, 4)."""
    x, y, z = axis.direction
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    move = np.eye(4)
    move[:3, :3], move[:3, 3] = turn, axis.point_m - turn @ axis.point_m
    return move


def by_screws(axes: list[Axis], tip: np.ndarray, q: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    for axis, angle in zip(axes, q, strict=True):
        pose = pose @ turned(axis, angle)
    return pose @ tip


def by_rows(rows: tuple[Row, ...], convention: Convention, q: np.ndarray) -> np.ndarray:
    dh = np.array([(r.d_m, r.theta_rad, r.L_m, r.alpha_rad) for r in rows])
    turns = [row.joint is not None for row in rows]
    return np.asarray(link_transforms(dh, q[None], turns, convention)[0][-1])


def some_axes(rng: np.random.Generator) -> tuple[list[Axis], np.ndarray]:
    """2 to 7 axes: skew, parallel, antiparallel, along the base's axes, crossing, and off parallel by 1e-13 to 0.1 rad."""
    axes: list[Axis] = []
    for _ in range(int(rng.integers(2, 8))):
        before = axes[-1] if axes else Axis(np.zeros(3), np.array([0.0, 0.0, 1.0]))
        direction = [
            rng.normal(size=3),
            before.direction * rng.choice([-1.0, 1.0]),
            np.eye(3)[rng.integers(0, 3)] * rng.choice([-1.0, 1.0]),
            before.direction + 10.0 ** rng.uniform(-13, -1) * rng.normal(size=3),
        ][rng.integers(0, 4)]
        point = before.point_m + 0.3 * before.direction if rng.random() < 0.4 else 0.4 * rng.normal(size=3)
        axes.append(Axis(point, direction / np.linalg.norm(direction)))
    tip = np.eye(4)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    tip[:3, :3], tip[:3, 3] = turn * np.linalg.det(turn), rng.normal(size=3)
    return axes, tip


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_rows_move_the_tip_as_the_axes_do(convention: Convention) -> None:
    rng = np.random.default_rng(4)
    for _ in range(150):
        axes, tip = some_axes(rng)
        rows = dh_rows(axes, tip, convention)
        q = rng.uniform(-3.0, 3.0, len(axes))
        assert np.abs(by_rows(rows, convention, q) - by_screws(axes, tip, q)).max() < SAME_m
        assert [row.joint for row in rows if row.joint] == list(range(1, len(axes) + 1))


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_almost_parallel_axes_make_no_row_of_a_thousand_metres(convention: Convention) -> None:
    tilt = 3.7e-6  # of an angle that was rounded to 1.5708
    axes = [
        Axis(np.zeros(3), np.array([0.0, 1.0, 0.0])),
        Axis(np.array([0.0, 0.1, 0.4]), np.array([0.0, math.cos(tilt), math.sin(tilt)])),
    ]
    tip = np.eye(4)
    tip[:3, 3] = 0.1, 0.0, 0.7
    rows = dh_rows(axes, tip, convention)
    assert max(max(abs(row.d_m), abs(row.L_m)) for row in rows) < LARGEST_m
    assert np.abs(by_rows(rows, convention, np.array([0.3, -0.8])) - by_screws(axes, tip, np.array([0.3, -0.8]))).max() < SAME_m


def test_an_upright_arm_with_perpendicular_axes_gets_the_textbook_rows() -> None:
    y, z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    axes = [Axis(0 * z, z), Axis(0.1 * z, y), Axis(0.5 * z, y)]
    tip = np.eye(4)
    tip[2, 3] = 0.8
    rows = dh_rows(axes, tip, "standard")
    assert [(row.joint, round(row.d_m, 12), round(row.L_m, 12)) for row in rows] == [
        (1, 0.1, 0.0),
        (2, 0.0, 0.4),
        (3, 0.0, 0.0),
        (None, 0.3, 0.0),
    ]
