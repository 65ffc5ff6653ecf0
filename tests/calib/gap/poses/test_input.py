"""Poses that are odd or hopeless: said, answered as far as they go, or refused with what is wrong."""

import dataclasses

import numpy as np
import pytest

from benchmarks.gap.static.cases import ARM, Design, Hidden, designed
from calib.arm_problem.link_bending import bending_m
from calib.errors import UnusablePointsError
from calib.gap.poses.cautions import about_data, cleaned, require_posed
from calib.points.points import Points

POINTS = designed(31, (Hidden("backlash", 1, 0.006),), Design())[1]


def changed(**columns) -> Points:
    return dataclasses.replace(POINTS, **columns)


def said(points: Points) -> str:
    return " | ".join(about_data(ARM, points))


@pytest.mark.parametrize(
    ("columns", "says"),
    [
        ({"q_rad": np.degrees(POINTS.q_rad)}, "degrees"),
        ({"tip_m": 1e3 * POINTS.tip_m}, "millimetres"),
        ({"tip_m": POINTS.tip_m[:, [1, 0, 2]]}, "x_m and y_m look swapped"),
        ({"payload_kg": 1e3 * POINTS.payload_kg}, "grams"),
    ],
    ids=["degrees", "millimetres", "swapped", "grams"],
)
def test_misread_columns_are_refused_with_what_was_meant(columns, says) -> None:
    with pytest.raises(UnusablePointsError, match=says):
        require_posed(ARM, changed(**columns))


@pytest.mark.parametrize(
    ("columns", "says"),
    [
        ({"direction": np.zeros_like(POINTS.direction)}, "dir1"),
        ({"t_s": np.where(np.arange(len(POINTS)) > 100, POINTS.t_s - 500.0, POINTS.t_s)}, "line 103"),
        ({"t_s": np.full(len(POINTS), np.nan)}, "no t_s"),
        ({"current_A": np.full_like(POINTS.current_A, 0.5)}, "never changes"),
        ({"current_A": np.clip(POINTS.current_A, -8.0, 8.0) * 8.0}, "at the drive's limit of 8 A in "),
        ({"current_A": 1e3 * POINTS.current_A}, "milliamperes? Not used"),
        ({"setup": ("free",) * len(POINTS)}, "one setup"),
    ],
    ids=["no directions", "time backwards", "no time", "constant current", "saturated", "milliamperes", "one setup"],
)
def test_what_a_column_lacks_is_said(columns, says) -> None:
    assert says in said(changed(**columns))


def test_a_sound_recording_is_not_found_fault_with() -> None:
    assert said(POINTS) == ""


def test_currents_that_never_change_are_taken_for_none() -> None:
    fixed = cleaned(changed(current_A=np.full_like(POINTS.current_A, 0.5)))
    assert np.isnan(fixed.current_A).all()


def test_a_payload_at_the_end_of_a_beam_bends_it_as_the_textbook_says() -> None:
    """Level forearm, no own mass: P l^3 / 3 EI."""
    links = tuple(dataclasses.replace(link, mass_kg=link.mass_kg and 1e-9) for link in ARM.links)
    arm = dataclasses.replace(ARM, links=links)
    q = np.array([[0.2, -np.pi / 2, np.pi / 2]])  # upper arm level, forearm wherever
    for link, length in ((3, np.hypot(0.012, 0.3543)),):
        moved = bending_m(arm, q, np.array([0.5]), link)
        most = 0.5 * 9.81 * length**3 / 3.0
        assert np.linalg.norm(moved) <= most * 1.001
        folds = np.column_stack((np.full(400, 0.2), np.full(400, -1.0), np.linspace(-1.2, 1.5, 400)))
        level = np.linalg.norm(bending_m(arm, folds, np.full(400, 0.5), link), axis=1).max()
        assert level == pytest.approx(most, rel=1e-3)
