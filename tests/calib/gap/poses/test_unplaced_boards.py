"""Boards whose places nobody knows: each is placed by its own poses, so that none of them can report as a whole."""

import dataclasses

import numpy as np
import pytest

from calib.gap.poses.find import find
from calib.gap.poses.recordings import EVERY, parts, split
from calib.points.points import Points
from tests.calib.gap.poses.unplaced import arm, session


def from_one_side(points: Points) -> Points:
    return dataclasses.replace(points, direction=np.ones_like(points.direction))


@pytest.mark.parametrize("boards", [3, 4, 6])
def test_every_board_keeps_poses_that_place_it(boards: int) -> None:
    for points in (session(boards), from_one_side(session(boards))):
        divided = split(points)
        setups = np.array(points.setup)
        for name in set(points.setup):
            assert 0 < divided.report[setups == name].sum() <= len(points) / boards / EVERY
        labels = parts(points, 5)
        assert all(len(set(setups[labels == label])) == boards for label in set(labels.tolist()))


def test_an_arm_with_nothing_hidden_ends_at_the_noise_on_five_boards() -> None:
    found = find(arm(), from_one_side(session(5, seed=3))).finding
    assert [one.name.effect for one in found.effects] == ["link_geometry"]
    assert found.unknown is None
    assert found.gap_after < 1.3


def test_a_measured_place_is_distorted_only_where_places_are_measured() -> None:
    found = find(arm(), session(4, stiffness_Nm_rad=200.0)).finding
    told = [found.unknown.where] if found.unknown is not None else []
    assert not any("measured places" in where for where in (*told, *(one.where for one in found.remainder)))
