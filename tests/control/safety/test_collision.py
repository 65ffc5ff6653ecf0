"""Distances between capsules: closed form against points along both axes, and the bodies of the supplied pair."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from control.kinematics.kinematics import Corners, ForwardKinematics
from control.model.arm import Rest
from control.model.cell import Placed, load_cell
from control.model.description import load_arm
from control.safety.collision import FAR, ArmBody, Capsule, capsule, least_gap, middle, pairs_between

PAIR = load_cell("pair")
LEFT, RIGHT = (ArmBody(placed, PAIR.tool_length_m) for placed in PAIR.arms)
BOTH = ((0, 0),)
ROOT = Path(__file__).parents[3]


def sampled_gap(one: Capsule, other: Capsule) -> float:
    """By brute force: 101 points of each axis."""
    shares = np.linspace(0.0, 1.0, 101)[:, None]
    p, q = (np.array([c.x, c.y, c.z]) + shares * np.array([c.dx, c.dy, c.dz]) for c in (one, other))
    between = np.linalg.norm(p[:, None] - q[None], axis=2).min()
    return float(between) - one.radius_m - other.radius_m


def ends(part: Capsule) -> np.ndarray:
    """The ends of its axis."""
    start = np.array([part.x, part.y, part.z])
    return np.array([start, np.add(start, [part.dx, part.dy, part.dz])])


def drawn(source: random.Random, size_m: float = 0.5) -> Capsule:
    start, end = ([source.uniform(-size_m, size_m) for _ in range(3)] for _ in range(2))
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
        (((0, 0, 0), (1, 0, 0)), ((4, 4, 0), (2, 1, 0)), math.sqrt(2.0)),  # end against end
        (((1, 0, 0), (0, 0, 0)), ((2, 1, 0), (4, 4, 0)), math.sqrt(2.0)),  # beginnings
    ],
)
def test_known_gaps(one: tuple, other: tuple, gap_m: float) -> None:  # type: ignore[type-arg]
    for a, b in ((one, other), (other, one)):
        found = least_gap((capsule(*a, 0.0),), (capsule(*b, 0.0),), BOTH, math.inf)
        assert found.gap_m == pytest.approx(gap_m, abs=1e-6)


def test_a_capsule_is_held_by_the_sphere_about_it() -> None:
    found = capsule((1.0, -2.0, 3.0), (3.0, 2.0, 7.0), 0.25)
    assert found[:6] == (1.0, -2.0, 3.0, 2.0, 4.0, 4.0)
    assert found[6:] == pytest.approx((36.0, 0.25, 2.0, 0.0, 5.0, 3.25))


def test_of_many_pairs_the_nearest_is_found_whatever_the_spheres_leave_out() -> None:
    source = random.Random(6)
    for _ in range(60):
        one, other = ([drawn(source, 2.0) for _ in range(4)] for _ in range(2))
        pairs = tuple((i, j) for i in range(4) for j in range(4))
        gaps = {pair: least_gap(one, other, (pair,), math.inf).gap_m for pair in pairs}
        nearest = min(gaps, key=gaps.__getitem__)
        within_m = source.uniform(0.0, 0.4)
        found = least_gap(one, other, pairs, within_m)
        assert found == ((gaps[nearest], *nearest) if gaps[nearest] < within_m else FAR)
    assert (math.inf, -1, -1) == FAR


def test_two_bodies_meet_halfway_between_their_axes() -> None:
    source = random.Random(7)
    for _ in range(100):
        one, other = drawn(source), drawn(source)
        halfway_m = middle(one, other)
        point = capsule(halfway_m, halfway_m, 0.0)
        axes_m = least_gap((one,), (other,), BOTH, math.inf).gap_m + one.radius_m + other.radius_m
        for body in (one, other):
            away_m = least_gap((point,), (body,), BOTH, math.inf).gap_m + body.radius_m
            assert away_m == pytest.approx(0.5 * axes_m, abs=1e-5)


def test_what_is_beyond_the_limit_is_not_looked_at() -> None:
    one, other = capsule((0, 0, 0), (1, 0, 0), 0.05), capsule((0, 0.3, 0), (1, 0.3, 0), 0.05)
    assert least_gap((one,), (other,), BOTH, 0.19) == FAR
    assert least_gap((one,), (other,), BOTH, 0.21).gap_m == pytest.approx(0.2)


def test_a_body_ends_at_the_tip_and_begins_on_its_base() -> None:
    q_rad = (0.3, -0.5, 0.4)
    found = RIGHT.at(q_rad)
    tip = PAIR.placed("right").in_cell(ForwardKinematics(PAIR.placed("right").arm).tip(*q_rad))
    tool = found[-1]
    assert (tool.x + tool.dx, tool.y + tool.dy, tool.z + tool.dz) == pytest.approx(tip)
    assert math.sqrt(tool.dd) == pytest.approx(PAIR.tool_length_m, abs=1e-6)
    assert found[0][:3] == (0.0, -0.25, 0.0)
    assert RIGHT.names == ("base", "link 2", "link 3", "link 3", "tool")


# Its first axis is moved, so that its body begins off the axes of its base.
PANDA = load_arm(ROOT / "tests/control/model/arms/panda.toml")
THICK = replace(
    PANDA,
    links=tuple(
        replace(link, radius_m=0.05 + 0.005 * k, **({"L_m": 0.1, "alpha_rad": 0.3} if k == 0 else {}))
        for k, link in enumerate(PANDA.links)
    ),
    limits=replace(PANDA.limits, base_radius_m=0.1),
)


def test_a_body_runs_from_corner_to_corner_in_the_frame_of_the_cell() -> None:
    placed = Placed(THICK, (0.3, -0.7, 0.2), (0.1, 0.3, 0.5, 0.65**0.5))  # no entry of the matrix is 0
    body, corners = ArmBody(placed, 0.04), Corners(THICK)
    q_rad = (0.3, -0.5, 0.4, -1.2, 0.6, 1.1, -0.4)
    at = [placed.in_cell(corner) for corner in (corners.start_m, *corners.at(*q_rad))]
    base, *links, neck, tool = body.at(q_rad)
    assert ends(base) == pytest.approx(np.array([placed.in_cell((0, 0, 0)), placed.in_cell((0, 0, 0.333))]))
    for link, start, end in zip(links, at, at[1:], strict=False):
        assert ends(link) == pytest.approx(np.array([start, end]))
    assert ends(tool)[1] == pytest.approx(at[-1])
    assert math.sqrt(tool.dd) == pytest.approx(0.04, abs=1e-9)
    assert ends(neck) == pytest.approx(np.array([at[-2], ends(tool)[0]]))
    assert math.dist(*ends(neck)) + 0.04 == pytest.approx(math.dist(at[-2], at[-1]))
    radii_m = [part.radius_m for part in (base, *links, neck, tool)]
    assert radii_m == [0.1, *corners.radii_m, 0.0]
    assert len(set(radii_m)) == len(radii_m)
    assert body.joints == (0, 3, 4, 5, 7, 7, 7)


def test_a_tool_longer_than_the_last_link_leaves_no_neck() -> None:
    *_, neck, tool = ArmBody(Placed(THICK), 5.0).at((0.3, -0.5, 0.4, -1.2, 0.6, 1.1, -0.4))
    assert neck.dd == pytest.approx(0.0, abs=1e-11)
    assert ends(neck)[0] == pytest.approx(ends(tool)[0])


# At 0 and -0.9 rad of joint 6 the hand touches the forearm; at 1, -1.5 and -1.8 rad it does not.
@pytest.mark.parametrize(
    ("limits6_rad", "rest6_rad", "pose6_rad"),
    [((-2.4, 0.6), None, -0.9), ((-math.inf, math.inf), None, 0.0), ((-2.4, 0.6), -1.8, -1.8)],
)
def test_an_arm_may_meet_itself_where_two_joints_are_between_and_its_rest_pose_is_clear(
    limits6_rad: tuple[float, float], rest6_rad: float | None, pose6_rad: float
) -> None:
    folded = (0.5, 0.5, 0.0, -2.9, 0.0)
    limits = [(q - 0.1, q + 0.1) for q in folded] + [limits6_rad, (-2.0, 1.0)]
    any_drive = PAIR.placed("right").arm.drives[0]
    drives = tuple(
        replace(any_drive, joint=k, joint_lower_rad=lower, joint_upper_rad=upper)
        for k, (lower, upper) in enumerate(limits, start=1)
    )
    rest = None if rest6_rad is None else Rest((*folded, rest6_rad, -0.5))
    body = ArmBody(Placed(replace(THICK, drives=drives, rest=rest)), 0.04)
    parts = body.at((*folded, pose6_rad, -0.5))
    apart = [(i, j) for i in range(1, 7) for j in range(i + 1, 7) if body.joints[j] - body.joints[i] >= 2]
    assert body.own_pairs == tuple((i, j) for i, j in apart if sampled_gap(parts[i], parts[j]) > 0.0)
    assert ((3, 6) in body.own_pairs) is (pose6_rad < -1.0)


def test_neighbours_in_the_chain_and_one_rigid_link_never_meet_however_thin_they_are() -> None:
    pairs = ArmBody(Placed(PANDA), 0.04).own_pairs  # joints of its parts: 0, 3, 4, 5, 7, 7, 7
    assert pairs == ((1, 3), (1, 4), (1, 5), (1, 6), (2, 4), (2, 5), (2, 6), (3, 5), (3, 6))


def test_two_tools_may_touch_and_nothing_else_may() -> None:
    names = {(LEFT.names[i], RIGHT.names[j]) for i, j in pairs_between(LEFT, RIGHT)}
    assert ("tool", "tool") not in names
    assert {("tool", "link 3"), ("link 3", "tool"), ("base", "tool"), ("link 2", "link 2")} <= names
