"""Axes of neighbouring joints that are nearly parallel: DH rows hold a tilt about the link, and none across it.

Hayati and Mirmirani (J. Robotic Systems 2(4), 1985) give such a link a turn about y. Here it is the twist of a fixed row between
the two joints, which every part of the program knows already.
"""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise
from typing import Final

from control.errors import ArmError
from control.model.arm import Arm, Link
from control.model.effects import place_of

PARALLEL_rad: Final = math.radians(3.0)  # beyond, the common normal is where the rows put it


def parallel_joints(arm: Arm) -> tuple[int, ...]:
    """Joints (1-based) whose axis is nearly parallel to the next joint's, without a fixed row between."""
    rows = _rows_of_joints(arm)
    pairs = enumerate(pairwise(rows), start=1)
    return tuple(joint for joint, (row, after) in pairs if after == row + 1 and _twist(arm, row) < PARALLEL_rad)


def with_tilt_behind(arm: Arm, joint: int) -> Arm:
    """The same arm with a fixed row behind a joint (1-based) of `parallel_joints`: its twist tilts the next axis across the link.

    ArmError for any other joint.
    """
    if joint not in parallel_joints(arm):
        raise ArmError(
            f"arm {arm.name}: the axes of joints {joint} and {joint + 1} are not parallel, or have a fixed row between"
        )
    row = _rows_of_joints(arm)[joint - 1] + 1
    added = [Link("fixed", 0.0, math.pi / 2.0, 0.0, 0.0)]
    before, after = arm.links[:row], arm.links[row:]
    if arm.dh_convention == "modified":  # here a row turns about x before it turns about z
        added.append(Link("fixed", 0.0, -math.pi / 2.0, 0.0, 0.0))
    else:
        turned = dataclasses.replace(after[0], theta_rad=after[0].theta_rad - math.pi / 2.0)
        after = (turned, *after[1:])
    effects = tuple(
        dataclasses.replace(effect, joint=effect.joint + len(added))
        if place_of(effect.effect) == "link" and effect.joint is not None and effect.joint > row
        else effect
        for effect in arm.effects
    )
    made = arm.tolerances
    if made is not None:
        rows = [(link.d_m, link.theta_rad, link.L_m, link.alpha_rad) for link in added]
        made = made.with_rows(row, rows, after[0].theta_rad - arm.links[row].theta_rad)
    return dataclasses.replace(arm, links=(*before, *added, *after), effects=effects, tolerances=made)


def in_the_same_rows(first: Arm, second: Arm) -> tuple[Arm, Arm]:
    """Both arms with every row of `with_tilt_behind` that either of them has, so that their rows compare one by one.

    ArmError where their rows differ otherwise.
    """
    for joint in _only_in(second, first):
        first = with_tilt_behind(first, joint)
    for joint in _only_in(first, second):
        second = with_tilt_behind(second, joint)
    if (first.joints, first.dh_convention) != (second.joints, second.dh_convention):
        raise ArmError(f"arms {first.name} and {second.name} have other rows: no row of one stands for one of the other")
    return first, second


def numbers_before(arm: Arm, more: Arm) -> dict[int, int]:
    """Of every row (1-based) that has another number in `more`, which is `arm` with rows of `with_tilt_behind`: its number
    in `arm`.
    """
    count = 2 if more.dh_convention == "modified" else 1
    joints = _rows_of_joints(arm)
    ends = [joints[joint - 1] for joint in _only_in(more, arm)]
    moved = {row + 1 + count * sum(end < row for end in ends): row + 1 for row in range(len(arm.links))}
    return {number: before for number, before in moved.items() if number != before}


def _only_in(rows_of: Arm, arm: Arm) -> list[int]:
    """Joints with a fixed row behind them in `rows_of`, and none in `arm` where its axes are parallel."""
    rows = _rows_of_joints(rows_of)
    return [joint for joint in parallel_joints(arm) if joint < len(rows) and rows[joint] > rows[joint - 1] + 1]


def frame_behind(arm: Arm, joint: int) -> int:
    """The number of the frame (0: base) that a joint (1-based) turns."""
    return _rows_of_joints(arm)[joint - 1] + 1


def tilt_row(arm: Arm, joint: int) -> int:
    """The row (0-based) whose alpha is the tilt, of an arm of `with_tilt_behind`."""
    return _rows_of_joints(arm)[joint - 1] + (2 if arm.dh_convention == "modified" else 1)


def _rows_of_joints(arm: Arm) -> list[int]:
    return [row for row, turns in enumerate(arm.joints) if turns]


def _twist(arm: Arm, row: int) -> float:
    """The angle between a row's axis and the next row's [rad]."""
    alpha = arm.links[row + 1 if arm.dh_convention == "modified" else row].alpha_rad
    return abs(math.asin(math.sin(alpha)))
