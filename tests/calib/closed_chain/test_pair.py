"""Two arms in contact: exact derivatives, true arms found, the scale, contacts left out, contacts chosen, wrong files."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.observations import Frame
from calib.arrays import frozen
from calib.closed_chain.calibrate import calibrate_pair, choose_contacts, placed_by, remarks
from calib.closed_chain.pair_problem import Contacts, PairPlan, PairProblem
from calib.errors import UnusablePointsError
from calib.identify.determinability import determinability
from calib.identify.objective import LeastSquares
from console.main import main
from control.kinematics.kinematics import ForwardKinematics
from control.model.description import load_arm
from tests.calib.simulated import seated, true_dh

LEFT, RIGHT = load_arm("left"), load_arm("right")
ARMS = (LEFT, RIGHT)
BASE = Frame("right_base", frozen(Rotation.from_rotvec([0.01, -0.02, 0.3]).as_matrix()), frozen([0.05, -0.6, 0.01]))
NOISE_m = 1e-4
PLAN = PairPlan(objective=LeastSquares())


def session(
    seed: int, count: int, distances: tuple[float, ...], noise_m: float = NOISE_m
) -> tuple[tuple[np.ndarray, np.ndarray], Contacts]:
    """True DH tables of both arms, and contacts of them; the second arm is seated where the first one's tip is."""
    rng = np.random.default_rng(seed)
    true = (true_dh(rng, LEFT, 0.4), true_dh(rng, RIGHT, 0.4))
    q1 = rng.uniform([-2.0, -1.5, -1.0], [0.5, 0.7, 1.4], (6 * count, 3))
    apart = np.resize(distances, len(q1))
    way = rng.normal(size=(len(q1), 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    goal = ArmModel(LEFT).tips(true[0], q1) + apart[:, None] * way + rng.normal(0.0, noise_m, way.shape)
    goal = (goal - BASE.origin_m) @ BASE.rotation
    q2 = seated(ArmModel(RIGHT), true[1], goal, np.array([0.6, -0.5, 0.3]))
    closed = np.linalg.norm(ArmModel(RIGHT).tips(true[1], q2) - goal, axis=1) < 1e-9
    rows = np.flatnonzero(closed & (np.abs(q2).max(axis=1) < 2.5))[:count]
    assert len(rows) == count
    names = tuple(f"a:{k}:1" for k in range(count))
    return true, Contacts(names, ("a",) * count, frozen(q1[rows]), frozen(q2[rows]), frozen(apart[rows]))


def written(path: Path, contacts: Contacts) -> Path:
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["setup", "point", "repeat", *[f"q{k}_rad" for k in range(1, 7)], "distance_m"])
        for k in range(len(contacts)):
            table.writerow(["a", k, 1, *contacts.first_rad[k], *contacts.second_rad[k], contacts.distance_m[k]])
    return path


def test_derivatives_are_exact() -> None:
    _, contacts = session(1, 10, (0.0, 0.08))
    problem = PairProblem(ARMS, contacts, BASE, PairPlan(free_tools=("left", "right")))
    x = 0.2 * np.random.default_rng(2).uniform(-1, 1, len(problem.parameters))
    x[-6:] *= 0.02
    jacobian, h = problem.residuals_and_jacobian(x)[1], 1e-6
    slopes = [(problem.residuals(x + h * e) - problem.residuals(x - h * e)) / (2 * h) for e in np.eye(len(x))]
    assert np.abs(jacobian - np.stack(slopes, axis=2)).max() < 1e-7
    assert len(problem) == len(jacobian) == 5 + 2  # five contacts in one place, five distances in rows of three


def test_both_arms_are_found_and_contacts_left_out_close() -> None:
    true, contacts = session(3, 45, (0.0, 0.08))
    pair = calibrate_pair(ARMS, contacts, PLAN)
    assert pair.held_before_m.mean() > 1.5e-3
    assert pair.held_after_m.mean() < 2.5 * NOISE_m
    values = np.concatenate([dh.ravel() for dh in true])
    scores = [
        (one.value - value) / one.sd
        for one, value in zip(pair.estimates, values, strict=False)
        if one.is_determined and not np.isnan(one.sd)
    ]
    assert len(scores) > 8
    assert 0.4 < np.sqrt(np.mean(np.square(scores))) < 1.8
    rng = np.random.default_rng(4)
    q = rng.uniform(-1.0, 1.0, (100, 3))
    for k, arm in enumerate(pair.arms):  # shape of each workspace, from contacts in a part of it
        ours, theirs = ForwardKinematics(arm).tips(q), ArmModel(ARMS[k]).tips(true[k], q)
        off = np.linalg.norm(ours[1:] - ours[:-1], axis=1) - np.linalg.norm(theirs[1:] - theirs[:-1], axis=1)
        assert np.sqrt(np.mean(off**2)) < 1e-3


def test_a_known_distance_determines_the_scale_and_contacts_in_one_place_do_not() -> None:
    ranks = []
    for distances in ((0.0,), (0.0, 0.08)):
        _, contacts = session(5, 40, distances)
        problem = PairProblem(ARMS, contacts, BASE)
        ranks.append(determinability(problem.sensitivity(np.zeros(38)), problem.parameters).rank)
    assert ranks == [21, 22]


def test_distances_alone_are_enough_to_find_where_the_second_arm_stands() -> None:
    _, contacts = session(6, 30, (0.3,))
    pair = calibrate_pair(ARMS, contacts, PLAN)
    assert np.linalg.norm(pair.base.origin_m - BASE.origin_m) < 0.02
    assert pair.after_m.mean() < 2 * NOISE_m


def test_chosen_contacts_say_more_than_others() -> None:
    _, contacts = session(7, 60, (0.0, 0.08))
    chosen = choose_contacts(PairProblem(ARMS, contacts, placed_by(ARMS, contacts).base, PLAN), 15, NOISE_m)
    assert len(set(chosen)) == 15

    def information(rows: list[int]) -> float:
        problem = PairProblem(ARMS, contacts, BASE)
        known = determinability(problem.sensitivity(np.zeros(38)), problem.parameters)
        seen = (problem.of_contacts(np.zeros(38))[1][rows] @ known.basis / NOISE_m).reshape(-1, known.rank)
        return float(np.linalg.slogdet(np.eye(known.rank) + seen.T @ seen)[1])

    others = [information(np.random.default_rng(k).permutation(60)[:15].tolist()) for k in range(8)]
    assert information(chosen) > max(others)


def test_contacts_of_other_arms_and_too_few_are_refused() -> None:
    _, contacts = session(8, 12, (0.0,))
    swapped = Contacts(contacts.name, contacts.setup, contacts.second_rad[::-1], contacts.first_rad, contacts.distance_m)
    with pytest.raises(UnusablePointsError, match=r"stay open by \d+ mm \(median\) wherever"):
        calibrate_pair(ARMS, swapped, PLAN)
    with pytest.raises(UnusablePointsError, match="5 contacts: 6 are needed"):
        calibrate_pair(ARMS, contacts.chosen(range(5)), PLAN)


def test_contacts_that_were_none_are_named_and_so_is_a_file_that_makes_no_sense() -> None:
    _, contacts = session(11, 12, (0.0, 0.08))
    few = calibrate_pair(ARMS, contacts, PLAN)
    assert any("24 numbers determine" in one for one in remarks(few))
    before, after = np.full(12, 4e-3), np.full(12, 1e-4)
    found = replace(few, held_before_m=before, held_after_m=after, estimates=(), numbers_count=100)
    assert list(remarks(found)) == []
    after[7] = 9e-3
    assert next(remarks(found)) == "Contradicted by the others: a:7:1 (9.00 mm). Look at them; remove what was not a contact"
    assert "Check distance_m (in m)" in next(remarks(replace(found, held_after_m=before)))


def test_the_command_writes_both_arms_and_says_what_stays_open(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = written(tmp_path / "contacts.csv", session(9, 30, (0.0,))[1])
    run = ["calibrate-pair", "--arms", "left", "right", "--contacts", str(file), "--objective", "lsq"]
    assert main([*run, "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "On contacts not used" in said
    assert "leave the scale of both arms open" in said
    assert "origin_m = [" in said
    content = json.loads((tmp_path / "out" / "pair.json").read_text())
    assert np.linalg.norm(np.array(content["second_base"]["origin_m"]) - BASE.origin_m) < 0.02
    made = load_arm(str(tmp_path / "out" / "left.toml"))
    assert made.calibration is not None
    assert made.dh.ravel()[6] == pytest.approx(content["parameters"]["left_L2"]["value"])
    assert main([*run, "--out", str(tmp_path / "out")]) == 2
    assert "never overwritten" in capsys.readouterr().err
    assert main([*run, "--choose", "4"]) == 0
    assert len(capsys.readouterr().out.split()) == 4


@pytest.mark.parametrize(
    ("change", "more", "says"),
    [
        (lambda text: text.replace("q6_rad", "q7_rad"), [], "the 3 joints of left, then the 3 of right"),
        (lambda text: text.replace(",0.0\n", ",-1\n").replace(",0.0\r\n", ",-1\r\n"), [], "expected a distance from 0 to 5 m"),
        (lambda text: text, ["--free-tool", "middle"], '--free-tool: expected some of left, right, got "middle"'),
        (lambda text: text, ["--fix", "left_L9"], "no parameter left_L9"),
        (lambda text: text, ["--bound", "L2=1mm"], "expected lengths=... or angles=..."),
        (lambda text: text, ["--choose", "99"], "99 contacts were requested, but only 6"),
    ],
)
def test_wrong_input_is_one_line(change, more: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:  # type: ignore[no-untyped-def]
    file = written(tmp_path / "contacts.csv", session(10, 6, (0.0,))[1])
    file.write_text(change(file.read_text()))
    assert (
        main(["calibrate-pair", "--arms", "left", "right", "--contacts", str(file), "--out", str(tmp_path / "out"), *more]) == 2
    )
    error = capsys.readouterr().err
    assert says in error
    assert "Traceback" not in error
