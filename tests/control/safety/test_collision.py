"""Distances between capsules: closed form against points along both axes, and the bodies of the supplied pair."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest

from control.kinematics.kinematics import Kinematics
from control.model.cell import load_cell
from control.safety.body import ArmBody, pairs_between
from control.safety.collision import FAR, Capsule, capsule, least_gap, middle

PAIR = load_cell("pair")
LEFT, RIGHT = (ArmBody(placed, PAIR.tool_length_m) for placed in PAIR.arms)
BOTH = ((0, 0),)


def sampled_gap(one: Capsule, other: Capsule) -> float:
    """By brute force: 101 points of each axis."""
    shares = np.linspace(0.0, 1.0, 101)[:, None]
    p, q = (np.array([c.x, c.y, c.z]) + shares * np.array([c.dx, c.dy, c.dz]) for c in (one, other))
    between = np.linalg.norm(p[:, None] - q[None], axis=2).min()
    return float(between) - one.radius_m - other.radius_m


def drawn(source: random.Random) -> Capsule:
    start, end = ([source.uniform(-0.5, 0.5) for _ in range(3)] for _ in range(2))
    return capsule(start, end if source.random() < 0.8 else start, source.uniform(0.0, 0.05))


def test_the_gap_of_two_capsules_is_that_of_points_along_them() -> None:
    source = random.Random(5)
    for _ in range(25):
        one, other = drawn(source), drawn(source)
        found, expected = least_gap((one,), (other,), BOTH, math.inf).gap_m, sampled_gap(one, other)
        assert expected - 6e-3 < found < expected + 1e-9  # the points are 17 mm apart at most
        halfway = middle(one, other)
        axes = found + one.radius_m + other.radius_m
        point = capsule(halfway, halfway, 0.0)
        assert sampled_gap(point, one) + one.radius_m == pytest.approx(0.5 * axes, abs=6e-3)


@pytest.mark.parametrize(
    ("one", "other", "gap_m"),
    [
        (((0, 0, 0), (1, 0, 0)), ((0, 0.2, 0), (1, 0.2, 0)), 0.2),  # parallel
        (((0, 0, 0), (1, 0, 0)), ((2, 0, 0), (3, 0, 0)), 1.0),  # in line
        (((0, 0, 0), (1, 0, 0)), ((0.5, -1, 0.1), (0.5, 1, 0.1)), 0.1),  # crossing
        (((0, 0, 0), (0, 0, 0)), ((0, 0, 1), (0, 0, 1)), 1.0),  # two points
        (((0, 0, 0), (1, 0, 0)), ((0.3, 0.4, 0), (0.3, 0.4, 0)), 0.4),  # a point beside a segment
        (((0, 0, 0), (1, 0, 0)), ((0.5, 0, -1), (0.5, 0, 1)), 0.0),  # through each other
    ],
)
def test_known_gaps(one: tuple, other: tuple, gap_m: float) -> None:  # type: ignore[type-arg]
    for a, b in ((one, other), (other, one)):
        found = least_gap((capsule(*a, 0.0),), (capsule(*b, 0.0),), BOTH, math.inf)
        assert found.gap_m == pytest.approx(gap_m, abs=1e-6)


def test_what_is_beyond_the_limit_is_not_looked_at() -> None:
    one, other = capsule((0, 0, 0), (1, 0, 0), 0.05), capsule((0, 0.3, 0), (1, 0.3, 0), 0.05)
    assert least_gap((one,), (other,), BOTH, 0.19) == FAR
    assert least_gap((one,), (other,), BOTH, 0.21).gap_m == pytest.approx(0.2)


def test_a_body_ends_at_the_tip_and_begins_on_its_base() -> None:
    q_rad = (0.3, -0.5, 0.4)
    found = RIGHT.at(q_rad)
    tip = PAIR.placed("right").in_cell(Kinematics(PAIR.placed("right").arm).tip(*q_rad))
    tool = found[-1]
    assert (tool.x + tool.dx, tool.y + tool.dy, tool.z + tool.dz) == pytest.approx(tip)
    assert math.sqrt(tool.dd) == pytest.approx(PAIR.tool_length_m, abs=1e-6)
    assert found[0][:3] == (0.0, -0.25, 0.0)
    assert RIGHT.names == ("base", "link 2", "link 3", "link 3", "tool")


def test_two_tools_may_touch_and_nothing_else_may() -> None:
    names = {(LEFT.names[i], RIGHT.names[j]) for i, j in pairs_between(LEFT, RIGHT)}
    assert ("tool", "tool") not in names
    assert {("tool", "link 3"), ("link 3", "tool"), ("base", "tool"), ("link 2", "link 2")} <= names
