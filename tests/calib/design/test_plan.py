"""A whole plan: what it says, what it writes, and that its poses are worth more than others."""

import dataclasses
import json

import numpy as np
import pytest

from benchmarks.calibration.design_trial import (
    ARM,
    NOISE_m,
    both,
    held_out_ratio,
    measured,
    planned,
    random_poses,
    spread,
    table_points,
)
from calib.arm_problem.assembly import Choice
from calib.arm_problem.observations import Frame
from calib.design.candidates import CameraBox, boards_in_the_way, free_candidates, workspace_poses
from calib.design.information import experiment_of, uncertainty_of
from calib.design.plan import in_words, plan_json, write_plan
from calib.design.planning import Request, plan_poses
from calib.errors import CalibrationError
from calib.identify.objective import LeastSquares, SumOfDistances
from calib.points.points import make_points, read_points

UNKNOWN = dataclasses.replace(ARM, table=dataclasses.replace(ARM.table, known_pose=False))
EVERYWHERE = workspace_poses(ARM, [], 300)
PLAN = plan_poses(ARM, None, Request(count=12))


def tip_m(points):
    """Predicted tip uncertainty [m] with these points."""
    experiment = experiment_of(ARM, points, EVERYWHERE, NOISE_m, Choice())
    return uncertainty_of(experiment, np.arange(len(points))).tip_m


def test_planned_free_poses_leave_less_uncertainty_than_random_and_spread_ones():
    """After a level board, by the tip criterion and by D; random ones as the median of ten."""
    rng = np.random.default_rng(0)
    dh, table = table_points(rng, ("normal",))

    def with_free(q):
        return tip_m(both(table, measured(dh, q, rng)))

    random = np.median([with_free(random_poses(rng, 12)) for _ in range(10)])
    by_tip, by_d = (with_free(planned(table, 12, criterion=name)) for name in ("tip", "D"))
    assert by_tip < 0.85 * min(random, with_free(spread(12)))
    assert by_d < 0.95 * min(random, with_free(spread(12)))


def test_three_tilts_and_twelve_planned_poses_keep_within_1_15_of_the_noise_everywhere():
    """One of the 24 seeds of docs/plan_poses.md, by the tip criterion, with both objectives."""
    rng = np.random.default_rng(0)
    dh, table = table_points(rng)
    points = both(table, measured(dh, planned(table, 12, criterion="tip"), rng))
    for objective in (SumOfDistances(), LeastSquares()):
        assert held_out_ratio(points, dh, objective, rng) <= 1.15


def test_plan_begins_with_the_bounds_and_ends_at_less_than_the_noise():
    assert PLAN.before.tip_m > 0.02
    assert PLAN.after.tip_m < NOISE_m
    assert len(PLAN.poses) == len(PLAN.points) == 12
    assert PLAN.combinations_count == PLAN.after.rank == 10


def test_gains_add_up_and_each_state_is_that_of_one_more_pose():
    assert sum(pose.gain for pose in PLAN.poses) == pytest.approx(PLAN.after.log_det - PLAN.before.log_det)
    assert [pose.after.points_count for pose in PLAN.poses] == list(range(1, 13))


def test_visits_point_into_the_file_in_visiting_order():
    for pose in PLAN.poses:
        k = pose.visit - 1
        assert (PLAN.points.setup[k], PLAN.points.point[k]) == (pose.setup, pose.point)
        assert PLAN.points.q_rad[k].tolist() == list(pose.q_rad)
    free = [point for setup, point in zip(PLAN.points.setup, PLAN.points.point, strict=True) if setup == "free"]
    assert free == [f"p{k}" for k in range(1, len(free) + 1)]


def test_roll_tilt_brings_more_than_pitch_and_free_poses_more_than_any_tilt():
    """Tilts fix alpha1 and d1, and roll conditions far better than pitch."""
    kinds = [one.setup for one in PLAN.alternatives]
    assert kinds[0] == "free"
    assert kinds.index("roll") < kinds.index("pitch")
    assert any(sentence.startswith("A roll tilt gains more than a pitch tilt") for sentence in in_words(PLAN))


def test_points_that_are_taken_count_and_are_not_planned_again():
    _, table = table_points(np.random.default_rng(1), ("normal",))
    plan = plan_poses(ARM, table, Request(count=6, only="table"))
    assert plan.before.points_count == 33
    assert plan.before.rank == 9
    assert "normal" not in plan.points.setup
    assert plan.after.tip_m < 0.2 * plan.before.tip_m


def test_so_many_free_poses_as_asked_for():
    plan = plan_poses(ARM, None, Request(count=6, free_count=3))
    assert plan.points.setup.count("free") == 3
    only = plan_poses(ARM, None, Request(count=2, free_count=2))
    assert set(only.points.setup) == {"free"}


def test_setups_asked_for_are_the_only_ones_planned():
    plan = plan_poses(ARM, None, Request(count=5, setups=("pitch", "roll-"), only="table"))
    assert set(plan.points.setup) <= {"pitch", "roll-"}
    assert set(plan.candidates) == {"pitch", "roll-"}
    assert any("register" in sentence for sentence in in_words(plan)) == ("roll-" in plan.points.setup)


def test_free_poses_keep_off_the_tilted_board_though_no_cavity_is_planned():
    points = plan_poses(ARM, None, Request(count=4, only="free")).points
    pool = free_candidates(ARM, boards_in_the_way(ARM, None, {}, {}))
    assert {tuple(q) for q in points.q_rad} <= {tuple(q) for q in pool.q_rad}
    assert [board.setup for board in boards_in_the_way(ARM, None, {}, {})] == ["normal", "roll", "pitch"]
    nowhere = dataclasses.replace(ARM.table, known_pose=False, origin_m=None)
    assert boards_in_the_way(dataclasses.replace(ARM, table=nowhere), None, {}, {}) == ()


def test_view_keeps_free_poses_where_the_camera_sees_them():
    view = CameraBox((0.2, -0.3, 0.0), (0.6, 0.3, 0.5))
    plan = plan_poses(ARM, None, Request(count=4, only="free", view=view))
    tips = plan.points.tip_m
    assert ((tips >= view.lower_m) & (tips <= view.upper_m)).all()


def test_noise_scales_what_is_left():
    """From nothing but the bounds, twelve poses decide all."""
    twice = plan_poses(ARM, None, Request(count=12, noise_m=2 * NOISE_m))
    assert twice.after.tip_m == pytest.approx(2 * PLAN.after.tip_m, rel=0.05)


def test_unknown_board_is_planned_on_and_is_said_not_to_tie_the_base():
    request = Request(count=6, only="table", setups=("normal",))
    plan = plan_poses(UNKNOWN, None, request)
    assert not plan.is_tied
    assert any("not tied" in sentence for sentence in in_words(plan))
    seen = {"normal": Frame("table_normal", np.eye(3), np.array([0.5, 0.0, 0.0]))}
    assert plan_poses(UNKNOWN, None, request, Choice(boards=seen)).is_tied


def test_boards_at_unknown_places_are_planned_in_more_than_one_tilt():
    """One by one no cavity of a second board is worth anything: its first three only tell where it stands."""
    plan = plan_poses(UNKNOWN, None, Request(count=12, only="table"))
    level = plan_poses(UNKNOWN, None, Request(count=12, only="table", setups=("normal",)))
    assert len(set(plan.points.setup)) > 1
    assert plan.after.tip_m < 0.5 * level.after.tip_m


def test_where_all_frames_are_unknown_free_poses_are_still_found_to_be_best():
    """Each frame takes six unknowns: two tilts would cost twelve, and the camera's base frame alone six."""
    loose, view = Choice(freed=("base", "table", "tool")), CameraBox((0.0, -1.0, 0.0), (1.0, 0.0, 1.0))
    assert set(plan_poses(ARM, None, Request(count=6, setups=("roll", "pitch"), view=view), loose).points.setup) == {"free"}


def test_board_whose_tips_were_measured_will_be_measured_again():
    """A camera that saw the tip in the cavities ties them to the base, unknown board or not."""
    _, table = table_points(np.random.default_rng(1), ("normal",))
    blind = make_points(table.setup, table.point, table.repeat, table.q_rad, np.full((33, 3), np.nan))
    seen = plan_poses(UNKNOWN, table, Request(count=4, only="table", setups=("roll",)))
    unseen = plan_poses(UNKNOWN, blind, Request(count=4, only="table", setups=("roll",)))
    assert seen.is_tied
    assert not unseen.is_tied


def test_same_request_gives_the_same_plan():
    again = plan_poses(ARM, None, Request(count=12))
    assert json.dumps(plan_json(again, "right")) == json.dumps(plan_json(PLAN, "right"))


def test_files_are_read_back_as_they_were_meant(tmp_path):
    table, text = write_plan(tmp_path / "new", PLAN, "right")
    header = table.read_text().splitlines()[0].split(",")
    assert header == ["setup", "point", "repeat", "q1_rad", "q2_rad", "q3_rad"]
    points, warnings = read_points(table, 3)
    assert not warnings
    np.testing.assert_allclose(points.q_rad, PLAN.points.q_rad, atol=1e-11)
    content = json.loads(text.read_text())
    assert content["format"] == "plan/1"
    assert len(content["points"]) == 12
    assert set(content["points"][0]["after"]["observability"]) == {"O1", "O2", "O3", "O4", "O5"}
    assert content["in_words"] == list(in_words(PLAN))


@pytest.mark.parametrize(
    ("arm", "request_", "message"),
    [
        (ARM, Request(criterion="best"), "criterion: expected one of D, O1"),
        (ARM, Request(setups=("yaw",)), 'setup: expected some of normal.*got "yaw"'),
        (ARM, Request(count=0), "number of poses: expected one or more, got 0"),
        (ARM, Request(count=200, only="table"), "200 poses were requested, but only 99 are available"),
        (ARM, Request(count=10, free_count=12), "free poses: expected 0 to 10"),
        (ARM, Request(noise_m=-1.0), "noise of a measured coordinate.*got -1"),
        (dataclasses.replace(ARM, camera=None), Request(), "give --noise"),
        (dataclasses.replace(ARM, camera=None), Request(only="free", noise_m=1e-4), r"no \[camera\]"),
        (dataclasses.replace(ARM, camera=None, table=None), Request(noise_m=1e-4), r"neither a \[table\] nor a \[camera\]"),
        (dataclasses.replace(ARM, camera=None, table=None), Request(), r"neither .* add \[camera\] with position_noise_m"),
        (ARM, Request(only="free", view=CameraBox((5.0, 5.0, 5.0), (6.0, 6.0, 6.0))), "no pose is left to plan"),
    ],
)
def test_request_that_cannot_be_met_is_one_error(arm, request_, message):
    with pytest.raises(CalibrationError, match=message):
        plan_poses(arm, None, request_)
