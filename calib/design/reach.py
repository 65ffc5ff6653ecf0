"""Reachable poses of an arm: within its limits, clear of floor and board, with the tip at a given position."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from calib.arm_problem.arm_model import ArmModel
from calib.arrays import Array
from calib.design.boards import PlacedBoard
from control.kinematics.chain import link_transforms
from control.model.arm import Arm

Mask = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]
LIMIT_MARGIN_RAD = 0.05  # an uncalibrated arm turns a little further than planned
TOUCH_M = 0.0005  # depth of a tip in a cavity
BOARD_EDGE_M = 0.03  # the board reaches this far beyond its outermost cavity
STEPS_LIMIT = 60
LONGEST_STEP_RAD = 0.4
DAMPING = 1e-4  # of J J', [m^2/rad^2]
SAME_POSTURE_RAD = 1e-3


def joint_box(arm: Arm, margin_rad: float = LIMIT_MARGIN_RAD) -> tuple[Array, Array]:
    """Lower and upper joint angles (n,) to plan within; a joint without limits gets one whole turn."""
    limits = np.array(arm.limits_rad)
    lower = np.where(np.isfinite(limits[:, 0]), limits[:, 0], -np.pi)
    upper = np.where(np.isfinite(limits[:, 1]), limits[:, 1], np.pi)
    margin = np.minimum(margin_rad, 0.25 * (upper - lower))
    return lower + margin, upper - margin


def spread_poses(box: tuple[Array, Array], count: int, edge_share: float = 0.0) -> Array:
    """Poses (count, n) spread evenly over the box by Halton's sequence (deterministic).

    In the second half, each angle is moved to the nearer end of its range with probability `edge_share`: informative poses
    are often there.
    """
    lower, upper = box
    places = np.column_stack([_radical_inverse(count, base) for base in _primes(len(lower))])
    if edge_share > 0.0:
        draw = np.random.default_rng(0).random(places.shape) < edge_share
        draw[: count // 2] = False
        places = np.where(draw, np.round(places), places)
    return np.asarray(lower + places * (upper - lower))


def _radical_inverse(count: int, base: int) -> Array:
    """Halton's sequence in one base: the digits of 1 .. count mirrored at the point."""
    left, inverse, share = np.arange(1, count + 1), np.zeros(count), 1.0 / base
    while left.any():
        inverse += share * (left % base)
        left, share = left // base, share / base
    return inverse


def _primes(count: int) -> list[int]:
    found: list[int] = []
    number = 2
    while len(found) < count:
        if all(number % prime for prime in found):
            found.append(number)
        number += 1
    return found


def postures(
    model: ArmModel, targets_m: Array, starts_rad: Array, box: tuple[Array, Array]
) -> tuple[Array, Rows]:
    """Poses with the tip at the targets (c, 3): (q (p, n), which target each belongs to (p,)).

    By damped least squares from every start (s, n) within the box; equal postures are returned once.
    """
    q = np.tile(starts_rad, (len(targets_m), 1))
    which = np.repeat(np.arange(len(targets_m)), len(starts_rad))
    goal = targets_m[which]
    for _ in range(STEPS_LIMIT):
        slopes = model.slopes(model.nominal_dh, q)
        miss = goal - slopes.tips
        if np.max(np.abs(miss), initial=0.0) < 1e-9:
            break
        by_q = slopes.by_dh[:, :, list(model.theta_places)]
        damping = 1e-12 + DAMPING * np.minimum(1.0, 1e2 * np.einsum("mi,mi->m", miss, miss))
        square = np.einsum("mik,mjk->mij", by_q, by_q) + damping[:, None, None] * np.eye(3)
        step = np.einsum("mik,mi->mk", by_q, np.linalg.solve(square, miss[:, :, None])[:, :, 0])
        step *= np.minimum(1.0, LONGEST_STEP_RAD / np.maximum(1e-12, np.abs(step).max(axis=1, keepdims=True)))
        q = np.clip(q + step, *box)
    is_there = np.linalg.norm(goal - model.tips(model.nominal_dh, q), axis=1) < 1e-7
    return _different(q[is_there], which[is_there])


def _different(q: Array, which: Rows) -> tuple[Array, Rows]:
    """Remove duplicate postures."""
    keys = np.column_stack((which, np.round(q / SAME_POSTURE_RAD)))
    _, first = np.unique(keys, axis=0, return_index=True)
    first.sort()
    return q[first], which[first]


def body_points(arm: Arm, q_rad: Array) -> Array:
    """Points along the arm from the first joint's frame to the tip, (m, p, 3), base frame; the last is the tip."""
    frames = link_transforms(arm.dh, q_rad, arm.joints, arm.dh_convention)
    tips = frames[:, -1, :3, 3] + frames[:, -1, :3, :3] @ np.array(arm.tool.position_m)
    corners = np.concatenate((frames[:, 1:, :3, 3], tips[:, None]), axis=1)
    between = [
        corners[:, :-1] + share * (corners[:, 1:] - corners[:, :-1]) for share in (0.0, 0.25, 0.5, 0.75)
    ]
    return np.concatenate((*between, tips[:, None]), axis=1)


def is_above_floor(arm: Arm, points_m: Array) -> Mask:
    """Mask (m, p) of the points (m, p, 3) above the floor of the arm's limits."""
    return np.asarray(points_m[:, :, 2] >= arm.limits.floor_z_m + arm.limits.floor_clearance_m - TOUCH_M)


def heights_over_board(points_m: Array, board: PlacedBoard) -> tuple[Array, Mask]:
    """Height of points (m, p, 3) above a board's plane, and which of them are over the board, both (m, p)."""
    local = (points_m - board.origin_m) @ board.rotation
    is_over = np.hypot(local[:, :, 0], local[:, :, 1]) <= board.reach_m + BOARD_EDGE_M
    return local[:, :, 2], is_over & board.has_plane
