"""A check-up decides rightly on arms that are made without this project's kinematics, and says when it cannot."""

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from benchmarks.calibration.checkup import before, checked, visits_of
from benchmarks.calibration.trust_coverage import session
from calib.arm_problem.arm_model import ArmModel
from calib.arrays import Array
from calib.checkup import (
    BENT_m,
    ExpectedTips,
    SIZE_rad,
    SLIP_rad,
    causes_of,
    decide,
    decision_json,
    expectation_of,
    judged,
    sentences,
)
from calib.design.candidates import workspace_poses
from calib.errors import CalibrationError
from calib.points.points import make_points
from calib.points.writer import write_points
from console.commands.calibration.check_up import mocked_arm
from console.main import main
from control.dynamics.static_pose import resting
from control.model.arm import Arm, Calibration
from control.model.description import load_arm

ARM = load_arm("right")
NOISE_m = 1e-4
SEED = 7100


@cache
def quiet(count: int = 16) -> ExpectedTips:
    """Poses of an arm that is known to NOISE_m, at which nothing has changed."""
    model, q = ArmModel(ARM), workspace_poses(ARM, (), 8 * count)[:count]
    side = np.where(np.arange(count)[:, None] % 2 == 0, 1.0, -1.0) * np.ones(3)
    slopes, state = model.slopes(ARM.dh, q), resting(ARM, q, side)
    scatter = np.tile(NOISE_m**2 * np.eye(3), (count, 1, 1))
    left = np.random.default_rng(1).normal(0.0, NOISE_m, (count, 3))
    largest_Nm = np.maximum(1e-9, np.abs(state.gravity_Nm).max(axis=0))
    return ExpectedTips(
        left_m=left,
        covariance=NOISE_m**2 * np.eye(3 * count),
        scatter_m2=scatter,
        by_joint=slopes.by_dh[:, :, list(model.theta_places)],
        by_link=np.asarray(slopes.by_dh),
        tip_m=slopes.tips,
        flank=state.flank,
        load=np.where(largest_Nm > 1e-3, state.gravity_Nm / largest_Nm, 0.0),
        held=np.where(largest_Nm > 1e-3, state.held_Nm / largest_Nm, 0.0),
        q_rad=q,
        model=model,
        dh=ARM.dh,
        tool_m=np.array(ARM.tool.position_m),
    )


def moved(shift_m: Array, at: ExpectedTips | None = None) -> ExpectedTips:
    at = at or quiet()
    return dataclasses.replace(at, left_m=at.left_m + shift_m)


def test_an_arm_as_it_was_is_fine() -> None:
    decision = decide(quiet())
    assert (decision.action, decision.is_sure) == ("fine", True)
    assert decision.left_m == pytest.approx(decision.expected_m, rel=0.3)


@pytest.mark.parametrize("joint", [1, 2, 3])
def test_a_zero_that_moved_a_little_is_recalibrated_and_one_that_slipped_is_looked_at(joint: int) -> None:
    small, large = (decide(moved(quiet().turned_m(joint - 1, angle))) for angle in (0.5 * SLIP_rad, -5.0 * SLIP_rad))
    assert small.action == "recalibrate"
    assert (large.action, large.is_sure) == (f"inspect joint {joint}", True)
    assert small.causes[0].amplitudes[0] == pytest.approx(0.5 * SLIP_rad, rel=0.1)
    assert large.causes[0].amplitudes[0] == pytest.approx(-5.0 * SLIP_rad, rel=0.02)
    assert "slipped coupling" in " ".join(sentences(large))


@pytest.mark.parametrize("joint", [1, 2, 3])
def test_play_and_give_are_told_apart_from_a_zero(joint: int) -> None:
    at = quiet()
    moves = at.by_joint[:, :, joint - 1]
    worn = decide(moved(-0.5 * 4e-3 * at.flank[:, joint - 1, None] * moves))
    assert worn.action == f"inspect joint {joint}"
    assert worn.causes[0].cause.kind == "play" or joint == 3  # friction holds more than gravity there: alike
    if joint > 1:  # gravity does not load the first
        soft = decide(moved(-4e-3 * at.load[:, joint - 1, None] * moves))
        assert (soft.action, soft.causes[0].cause.kind) == (f"inspect joint {joint}", "load")


def test_a_bent_link_and_a_moved_base_are_named() -> None:
    at = quiet()
    bent = decide(moved(at.by_link[:, :, 6] * 2.0 * BENT_m))  # link 2 is longer
    assert (bent.action, bent.causes[0].cause.kind) == ("inspect link 2", "link")
    shifted = decide(moved(np.tile([2e-3, 0.0, 1e-3], (16, 1))))
    assert (shifted.action, shifted.causes[0].cause.kind) in {("recalibrate", "frame"), ("recalibrate", "link")}


def test_what_no_single_cause_explains_is_recalibrated_and_says_so() -> None:
    at = quiet()
    decision = decide(moved(at.turned_m(0, 4e-3) + at.turned_m(2, -5e-3) - 2e-3 * at.flank[:, 1, None] * at.by_joint[:, :, 1]))
    assert decision.action == "recalibrate"
    assert "no single cause explains it" in " ".join(sentences(decision))


def test_a_cause_that_explains_most_is_named_although_something_smaller_is_left() -> None:
    at = quiet()
    soft = decide(moved(-1.4e-2 * at.load[:, 1, None] * at.by_joint[:, :, 1] + at.turned_m(0, 1e-3)))
    assert (soft.action, soft.is_all) == ("inspect joint 2", False)
    assert "something smaller may have changed as well" in " ".join(sentences(soft))


def test_a_change_below_a_visits_scatter_is_none_and_few_poses_are_not_sure_of_what() -> None:
    at = quiet()
    assert decide(moved(at.turned_m(1, 1.2e-4))).action == "fine"
    few = decide(moved(at.turned_m(1, 3e-3).copy()).chosen([0, 1]))
    assert sum(one.probability for one in judged(moved(at.turned_m(1, 3e-3)).chosen([0, 1]))) == pytest.approx(1.0)
    assert few.action != "fine"
    if not few.is_sure:
        assert "Not sure" in " ".join(sentences(few))


def test_worn_play_is_found_by_the_poses_that_were_designed_for_the_arm() -> None:
    found = checked(SEED, "worn play", 2)
    assert (found.action, found.is_sure) == ("inspect joint 2", True)
    assert decision_json(found)["action"] == "inspect joint 2"
    q, direction = visits_of(SEED)
    assert len(q) == 16
    assert np.array_equal(direction[::2], -direction[1::2])
    assert np.array_equal(q[::2], q[1::2])


def test_the_designed_poses_tell_zeros_and_play_apart_better_than_any_others_drawn() -> None:
    rng, pool = np.random.default_rng(5), workspace_poses(ARM, (), 64)
    q, direction = visits_of(SEED)
    count = len(q)
    others = 12
    drawn = np.concatenate([pool[rng.choice(len(pool), count // 2, replace=False)] for _ in range(others)])
    sides = rng.choice((-1.0, 1.0), drawn.shape)
    q = np.concatenate((q, np.repeat(drawn, 2, axis=0)))
    direction = np.concatenate((direction, np.stack((sides, -sides), axis=1).reshape(-1, 3)))
    names = [f"c{k}" for k in range(len(q))]
    made = make_points(["free"] * len(q), names, [1] * len(q), q, ArmModel(ARM).tips(ARM.dh, q), direction)
    everything = expectation_of(ARM, before(SEED), made)

    def told(first: int) -> float:
        at = everything.chosen(list(range(first, first + count)))
        moves = [cause.columns.reshape(3 * count, -1) for cause in causes_of(at) if cause.kind in ("zero", "play")]
        columns = SIZE_rad * np.concatenate(moves, axis=1)
        information = columns.T @ np.linalg.solve(at.covariance, columns)
        return float(np.linalg.slogdet(np.eye(len(information)) + information)[1])

    assert told(0) > max(told(count * k) for k in range(1, others + 1))


def test_recorded_poses_are_decided_without_moving(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    earlier = before(SEED)
    write_points(tmp_path / "before.csv", earlier.chosen(list(range(0, len(earlier), 4))))
    write_points(tmp_path / "new.csv", earlier.chosen(list(range(1, len(earlier), 24))))
    line = ["check-up", "--arm", "right", "--points", str(tmp_path / "before.csv"), "--out", str(tmp_path / "out")]
    assert main([*line, "--recorded", str(tmp_path / "new.csv")]) == 0
    assert "Fine (" in capsys.readouterr().out
    assert (tmp_path / "out" / "check-up.json").exists()
    assert main([*line, "--recorded", str(tmp_path / "new.csv")]) == 2
    assert "never overwritten" in capsys.readouterr().err


def test_a_mock_of_a_calibrated_arm_is_made_of_the_file_that_it_came_from() -> None:
    def calibrated(source: str) -> Arm:
        return dataclasses.replace(ARM, calibration=Calibration(source, {}, "2026-01-01", "E2", "0.1.0"))

    assert mocked_arm(ARM) is ARM
    assert mocked_arm(calibrated("left.toml")).name == "left"
    with pytest.raises(CalibrationError, match=r"elsewhere\.toml is neither beside it nor in this folder"):
        mocked_arm(calibrated("elsewhere.toml"))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--poses", "2"], "--poses: expected 3 to 40"),
        (["--recorded", "new.csv", "--mock"], "nothing moves; omit --mock"),
        (["--seed", "3"], "--scenario and --seed need --mock"),
        (["--recorded", "none.csv"], "none.csv"),
        (["--plan-only"], "expected at least 10 points with a measured tip"),
    ],
)
def test_wrong_input_moves_nothing(
    options: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    few = session(SEED, (), np.zeros((1, 3))).points.chosen([0, 1, 2, 40] if "--plan-only" in options else list(range(12)))
    write_points(tmp_path / "points.csv", few)
    assert main(["check-up", "--arm", "right", "--points", "points.csv", "--out", "out", *options]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_plan_needs_no_folder_and_a_check_up_asks_for_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_points(tmp_path / "points.csv", session(SEED, (), np.zeros((1, 3))).points)
    asked = ["check-up", "--arm", "right", "--points", "points.csv"]
    assert main([*asked, "--plan-only"]) == 0
    assert "minutes" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        main(asked)
    assert "required: --out (only --plan-only needs none)" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["points.csv"]


@pytest.mark.parametrize("seed", range(5))
def test_tips_that_are_all_somewhat_farther_off_than_expected_are_no_change(seed: int) -> None:
    at = quiet()
    left = np.random.default_rng(seed).normal(0.0, 1.4 * NOISE_m, at.left_m.shape)
    decision = decide(dataclasses.replace(at, left_m=left))
    assert (decision.action, decision.is_sure) == ("fine", True)
    assert decision.causes[0].cause.kind == "nothing"
