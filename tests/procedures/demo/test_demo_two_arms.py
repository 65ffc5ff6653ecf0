"""Contacts of the demo's two arms come from the physics: tips really meet, wherever the files say that the arms stand."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from calib.closed_chain.conduct import conduct, contact_plan
from calib.closed_chain.pair_problem import read_contacts
from calib.closed_chain.planning import Candidates, contact_candidates
from calib.session.conversation import Recorded, unattended
from calib.session.folder import SessionFolder
from control.model.cell import load_cell
from control.recording.reading import Recording
from procedures.mock import CellBench, as_bolted_down
from procedures.mock_session import MockPairHand, pair_station
from tests.cell import scenario
from tests.pair import APART

PAIR, NAMES = load_cell("pair"), ("left", "right")


def a_bar() -> Candidates:
    """A contact at the ends of a bar."""
    return contact_candidates(PAIR, NAMES, (0.1,), drawn=50).chosen([0])


def test_contacts_are_those_of_the_true_arms(tmp_path: Path) -> None:
    standing = as_bolted_down(PAIR, seed=3)
    assert 1e-3 < math.dist(standing.arms[1].origin_m, PAIR.arms[1].origin_m) < 0.02
    bench = CellBench(standing, scenario(APART, base="demo"), tmp_path / "log")
    truth = []
    try:
        for client in bench.start(PAIR).values():
            client.enable()
        hand = MockPairHand(PAIR, NAMES, bench)
        station = pair_station(PAIR, NAMES, bench.clients, 1.0, 0.0, hand)
        with SessionFolder(tmp_path, contact_plan(NAMES, "00", a_bar().contacts, "hand")) as folder:
            for saying in unattended(conduct(folder, station)):
                if isinstance(saying, Recorded):
                    apart_m = math.dist(bench.tip_m("left"), bench.tip_m("right"))
                    assert apart_m == pytest.approx(0.1, abs=5e-4)
                    truth.append([q for name in NAMES for q in bench.rig.mock.robots[name].joint_rad()])
    finally:
        bench.close()
    contacts, _ = read_contacts(tmp_path / "points.csv", (PAIR.arms[0].arm, PAIR.arms[1].arm))
    assert contacts.distance_m.tolist() == [0.1]
    assert np.hstack((contacts.first_rad, contacts.second_rad)) == pytest.approx(np.array(truth), abs=3e-3)
    rows = {name: Recording.open(bench.recording / f"{name}.armlog").row_count for name in NAMES}
    assert rows["left"] == rows["right"] > 100
