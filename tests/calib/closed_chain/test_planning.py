"""Planned contacts: both arms reach them, clear of each other, and what they determine is said."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from benchmarks.arms import FOUR, SIX
from calib.arm_problem.arm_model import ArmModel
from calib.arrays import norms
from calib.closed_chain.planning import AWAY_m, Candidates, MARGIN_m, contact_candidates, plan_contacts
from calib.errors import CalibrationError
from console.main import main
from control.model.cell import Cell, Placed, load_cell
from control.safety.collision import ArmBody, least_gap, pairs_between

PAIR = load_cell("pair")
NAMES = ("left", "right")


@cache
def candidates() -> Candidates:
    return contact_candidates(PAIR, NAMES, (0.0, 0.1), drawn=600)


def tips(first_rad: np.ndarray, second_rad: np.ndarray) -> list[np.ndarray]:
    """Of both arms in the frame of the cell, by their models."""
    return [
        ArmModel(placed.arm).tips(placed.arm.dh, q_rad) @ np.array(placed.rotation).T + placed.origin_m
        for placed, q_rad in zip(PAIR.arms, (first_rad, second_rad), strict=True)
    ]


def test_tips_are_at_their_distance_and_shortly_before_a_little_back() -> None:
    contacts, found = candidates().contacts, candidates()
    assert {*contacts.distance_m.tolist()} == {0.0, 0.1}
    one, two = tips(contacts.first_rad, contacts.second_rad)
    assert norms(one - two) == pytest.approx(contacts.distance_m, abs=1e-6)
    before = tips(found.first_away_rad, found.second_away_rad)
    assert norms(before[0] - one) == pytest.approx(AWAY_m, abs=1e-6)
    assert norms(before[1] - two) == pytest.approx(AWAY_m, abs=1e-6)


def test_arms_are_clear_of_each_other_with_a_margin() -> None:
    bodies = [ArmBody(placed, PAIR.tool_length_m) for placed in PAIR.arms]
    pairs, contacts = pairs_between(*bodies), candidates().contacts
    gaps = [
        least_gap(bodies[0].at(q1), bodies[1].at(q2), pairs, 1.0).gap_m
        for q1, q2 in zip(contacts.first_rad.tolist(), contacts.second_rad.tolist(), strict=True)
    ]
    assert len(gaps) > 20
    assert min(gaps) >= PAIR.clearance_m + MARGIN_m


def test_the_command_writes_what_calibrate_pair_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calib.closed_chain.planning.contact_candidates", lambda *_, **__: candidates())
    file = tmp_path / "plan.csv"
    assert main(["plan-contacts", "--count", "12", "--distance", "0mm", "100mm", "--out", str(file)]) == 0
    assert "They determine 22 of 38 parameters" in capsys.readouterr().out
    again = ["--arms", "left", "right", "--contacts", str(file), "--choose", "3"]
    assert main(["calibrate-pair", *again]) == 0
    assert main(["plan-contacts", "--out", str(file)]) == 2
    assert "never overwritten" in capsys.readouterr().err
    with pytest.raises(CalibrationError, match=r"9999 contacts were requested, but there are only \d+ places"):
        plan_contacts(PAIR, NAMES, (0.0,), 9999)


def test_arms_of_other_kinds_meet_too_and_where_none_can_it_is_said() -> None:
    """Four joints, and six by modified DH with a wrist whose axes meet: its links there touch all the time."""
    arms = (Placed(FOUR, (0.0, 0.3, 0.0)), Placed(SIX, (0.0, -0.3, 0.0)))
    mixed = Cell("mixed", arms, clearance_m=0.01, tool_length_m=0.1)
    contacts = contact_candidates(mixed, ("four", "six"), (0.0,), drawn=60)
    assert len(contacts.contacts) >= 5
    assert contacts.contacts.second_rad.shape[1] == 6
    untouchable = dataclasses.replace(mixed, clearance_m=0.2)
    with pytest.raises(CalibrationError, match=r"there are only 0 places.*tool_length_m of an arm, 0.1 m here"):
        plan_contacts(untouchable, ("four", "six"), (0.0,), 3, drawn=20)
