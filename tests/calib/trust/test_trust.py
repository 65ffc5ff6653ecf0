"""The error map on arms whose truth is known: made without this project's kinematics and dynamics."""

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from benchmarks.calibration.trust_coverage import ARM, Session, session
from benchmarks.gap.static.cases import NOISE_m
from benchmarks.gap.static.physics import Hidden
from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.link_bending import Bending, known_bending
from calib.arrays import Array, norms
from calib.design.candidates import workspace_poses
from calib.points.points import make_points
from calib.trust.discrepancy import SHARES, ANGLE_LENGTH_rad, Conditions, Discrepancy, Gears, even_odds, smooth_functions
from calib.trust.prediction import SIZE_SPREAD, SIZES, SizeEvidence, TipError, linearised, planned, posterior_of, reliability_of
from calib.trust.report import pose_figures
from calib.trust.trust import ELLIPSOID_95, MapRequest, Trust, trust_in, within_95_m
from control.dynamics.static_pose import RestingPose
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Effect
from control.motion.waypoints import Waypoints
from tests.thirds import third_of

SQUARE = Waypoints(((0.45, 0.0, 0.2), (0.5, 0.05, 0.2), (0.55, 0.0, 0.2), (0.5, -0.05, 0.2)), (0.1,) * 4)
PLAY = Hidden("backlash", 3, 0.01)


@cache
def unseen_q() -> Array:
    return workspace_poses(ARM, (), 200)


@cache
def recorded(*hidden: Hidden) -> Session:
    return session(41, hidden, unseen_q())


@cache
def trusted(*hidden: Hidden) -> Trust:
    request = MapRequest((0.0, 1.0), 5e-4, 300, is_checked=hidden == (PLAY,))
    return trust_in(ARM, recorded(*hidden).points, request)


def inside(error: TipError, true_m: Array) -> float:
    left = true_m - error.tip_m - error.expected_m
    squares = np.einsum("mi,mi->m", left, np.linalg.solve(error.total_m2, left[:, :, None])[:, :, 0])
    return float(np.mean(squares < ELLIPSOID_95))


@pytest.mark.parametrize(
    "hidden",
    third_of(
        [
            (),
            (Hidden("joint_compliance", 2, 600.0),),
            (Hidden("encoder_eccentricity", 2, 0.008, 1.0),),
            (PLAY,),
            (Hidden("wobble", 2, 0.003, 1.0),),
        ]
    ),
    ids=["geometry", "compliance", "eccentricity", "play", "wobble"],
)
def test_true_errors_of_poses_that_were_not_recorded_lie_inside(hidden: tuple[Hidden, ...]) -> None:
    made, trust = recorded(*hidden), trusted(*hidden)
    error = trust.predictor.at(made.unseen)
    true_m = norms(made.true_m - error.tip_m)
    assert inside(error, made.true_m) >= 0.9
    left_m = norms(made.true_m - error.tip_m - error.expected_m)
    assert np.median(left_m) < 0.2 * np.median(true_m)  # the nominal file is centimetres off, and this is known
    if trust.coverage is not None:
        assert 0.85 <= trust.coverage.share <= 1.0


def test_play_is_no_systematic_error_where_nothing_tells_the_flank() -> None:
    trust = trusted(PLAY)
    loose = trust.discrepancy.unclear(recorded(PLAY).unseen, ARM.dh, np.array(ARM.tool.position_m))
    error = trust.predictor.at(recorded(PLAY).unseen)
    scatter_m = np.sqrt(np.trace(error.random_m2, axis1=1, axis2=2))
    moved = np.abs(loose[:, :, 2]).max(axis=1)  # by the standard deviation of where the gear lies
    is_loose, is_sure = moved > 0.1, moved < 1e-3
    assert is_loose.any()
    assert is_sure.any()
    assert scatter_m[is_loose].min() > 5.0 * scatter_m[is_sure].max()


def test_poses_with_visible_play_tell_their_flank_and_the_share_of_friction_on_the_links_side() -> None:
    rng = np.random.default_rng(3)
    gravity, held = rng.uniform(-0.5, 0.5, (200, 2)), rng.choice((-1.0, 1.0), (200, 2))
    open_ones = np.zeros(gravity.shape)
    state = RestingPose(gravity, held, open_ones, open_ones, np.zeros(gravity.shape, dtype=bool))
    gears = Gears(state, even_odds(2), np.array([0.01, 0.01]))
    move = np.tile([[1e-3, 3e-4], [0.0, 6e-4], [0.0, 0.0]], (200, 1, 1))
    flank = np.sign(gravity + 0.3 * held)
    left = np.einsum("mij,mj->mi", move, flank) + rng.normal(0.0, 2e-4, (200, 3))
    odds, told = gears.weighed(left, move, gears.expected(), 2e-4)
    assert odds @ SHARES == pytest.approx([0.3, 0.3], abs=0.03)
    assert np.mean(told * flank > 0.9) > 0.97
    known = dataclasses.replace(gears, odds=odds)
    clear = np.abs(gravity + 0.3 * held) > 0.1
    assert np.allclose(known.expected()[clear], flank[clear], atol=0.05)
    unseen = gears.weighed(left, 0.0 * move, gears.expected(), 2e-4)
    assert unseen[0] == pytest.approx(gears.odds)
    assert unseen[1] == pytest.approx(gears.expected(), abs=2.5e-3)  # no single pose decides more than MISTAKE


def test_a_map_without_points_far_from_the_table_says_so() -> None:
    points = recorded().points
    table = trust_in(
        ARM,
        points.chosen([k for k, setup in enumerate(points.setup) if setup == "normal"]),
        MapRequest(poses_count=300, is_checked=False),
    )
    assert np.median(table.within_95_m) > 2.0 * np.median(trusted().within_95_m)


def test_the_slope_of_the_evidence_is_its_slope() -> None:
    points = recorded().points
    problem = problem_of(ARM, points, Choice())
    at = Conditions(points.q_rad, points.direction, points.payload_kg, points.current_A)
    evidence = SizeEvidence(*linearised(problem, at, Discrepancy(ARM), np.zeros(16)), np.full(16, 0.3), Discrepancy(ARM))
    logs = np.log(np.array([2e-4, *(0.7 * one.usual for one in Discrepancy(ARM).sources)]))
    value, slope = evidence.minus_log(logs)
    for k in range(len(logs)):
        step = 1e-4 * np.eye(len(logs))[k]
        across = (evidence.minus_log(logs + step)[0] - evidence.minus_log(logs - step)[0]) / 2e-4
        assert slope[k] == pytest.approx(across, rel=1e-3, abs=1e-3)
    assert np.isfinite(value)


def test_known_without_the_base_moves_nothing_as_a_whole() -> None:
    arm = dataclasses.replace(ARM, table=None)
    points = recorded().points
    choice = Choice().for_points(arm, points)
    trust = trust_in(arm, points, MapRequest(poses_count=300, is_checked=False))
    assert "base" in choice.freed
    assert not trust.predictor.is_tied
    columns = trust.predictor.columns(Conditions.of(trust.q_rad))
    moved = columns @ np.linalg.cholesky(trust.posterior.covariance + 1e-18 * np.eye(len(trust.posterior.mean)))
    shift_m = np.sqrt(np.mean(moved, axis=0) ** 2).sum()
    assert shift_m < 0.2 * np.sqrt(np.mean(np.sum(moved**2, axis=(1, 2))))


def test_without_repeats_in_time_the_same_input_gives_the_same_map() -> None:
    again = trust_in(ARM, recorded().points, MapRequest((0.0, 1.0), 5e-4, 300, is_checked=False))
    assert np.array_equal(again.within_95_m, trusted().within_95_m)


def test_a_payload_never_makes_an_arm_more_certain() -> None:
    trust = trusted(Hidden("joint_compliance", 2, 600.0))
    bare, loaded = (trust.of_payload(mass)[0].error for mass in (0.0, 1.0))
    sd_m = [np.sqrt(np.trace(one.systematic_m2, axis1=1, axis2=2)).mean() for one in (bare, loaded)]
    assert sd_m[1] >= sd_m[0]


def test_the_probability_of_a_task_rises_with_its_tolerance() -> None:
    predictor, path = trusted().predictor, planned(ARM, SQUARE)
    first, *_ = tasks = [reliability_of(predictor, path, tolerance) for tolerance in (1e-4, 3e-3, 0.03, 0.3)]
    probabilities = [task.probability for task in tasks]
    assert probabilities == sorted(probabilities)
    assert (first.probability, probabilities[-1]) == (0.0, 1.0)
    for task in tasks:
        low, high = task.interval
        assert 0.0 <= low <= task.probability <= high <= 1.0
    assert 0.0 <= first.worst_time_s <= first.duration_s


def test_poses_are_joint_angles_where_the_file_knows_its_encoders() -> None:
    """An encoder that turns too little by 2 %, in the file and in the recording: nothing is left to be off."""
    scale, rng = 0.02, np.random.default_rng(9)
    arm = dataclasses.replace(ARM, effects=(Effect("encoder_scale", 2, {"scale": scale}),))
    q = unseen_q()[:40]
    tips = ForwardKinematics(ARM).tips(q) + rng.normal(0.0, NOISE_m, (len(q), 3))
    encoder = q / (1.0 + np.array([0.0, scale, 0.0]))
    points = make_points(["pose"] * 40, [f"p{k}" for k in range(20)] * 2, [1] * 20 + [2] * 20, encoder, tips)
    assert np.allclose(Conditions.recorded(arm, points).q_rad, q)
    trust = trust_in(arm, points, MapRequest(poses_count=200, is_checked=False))
    assert np.median(trust.within_95_m) < 2e-3
    assert np.allclose(trust.predictor.at(Conditions.recorded(arm, points)).tip_m, tips, atol=1e-3)


def test_iso9283_figures_of_a_programme_lie_in_their_intervals() -> None:
    visits, rng = 12, np.random.default_rng(8)
    at = np.tile(unseen_q()[:2], (visits, 1))
    made = session(41, (), at)
    names = ["P1", "P2"] * visits
    seen_m = made.true_m + rng.normal(0.0, NOISE_m, made.true_m.shape)
    points = make_points(["pose"] * len(names), names, [1] * len(names), at, seen_m, made.unseen.direction)
    trust = trusted()
    figures = pose_figures(trust.predictor, ARM, points, Path("points.csv"))
    assert [(figure.where, figure.visits) for figure in figures] == [("pose P1", visits), ("pose P2", visits)]
    for figure in figures:
        assert figure.measured_accuracy_m is not None
        assert figure.measured_repeatability_m is not None
        assert figure.repeatability_m is not None
        assert figure.accuracy_m.lower < figure.measured_accuracy_m < figure.accuracy_m.upper
        assert figure.repeatability_m.lower < figure.measured_repeatability_m < figure.repeatability_m.upper
        assert figure.accuracy_m.upper - figure.accuracy_m.lower < 0.2 * figure.accuracy_m.value
        assert figure.repeatability_m.upper < 3.0 * figure.repeatability_m.lower


def test_iso9283_figures_bend_links_at_the_joints_angles(monkeypatch: pytest.MonkeyPatch) -> None:
    """An encoder that turns too little by 20 %, as the file says: the link bends where the joint is, as in every prediction."""
    q, scale, rng = np.tile(unseen_q()[:2], (3, 1)), 0.2, np.random.default_rng(8)
    known = Effect("encoder_scale", 2, {"scale": scale}), Effect("link_flexure", 2, {"EI_Nm2": 40.0})
    encoder = q / (1.0 + np.array([0.0, scale, 0.0]))
    seen_m = ForwardKinematics(ARM).tips(q) + rng.normal(0.0, NOISE_m, (6, 3))
    points = make_points(["pose"] * 6, ["P1", "P2"] * 3, [1] * 6, encoder, seen_m)
    bent_at: list[Array] = []

    def bending(arm: Arm, q_rad: Array, payload_kg: Array) -> Bending | None:
        bent_at.append(q_rad)
        return known_bending(arm, q_rad, payload_kg)

    monkeypatch.setattr("calib.trust.report.known_bending", bending)
    pose_figures(trusted().predictor, dataclasses.replace(ARM, effects=known), points, Path("points.csv"))
    assert np.concatenate(bent_at) == pytest.approx(q[[0, 2, 4, 1, 3, 5]])


def test_95_percent_of_visits_keep_the_distance() -> None:
    error = TipError(np.zeros((1, 3)), np.zeros((1, 3)), 1e-6 * np.eye(3)[None], np.zeros((1, 3, 3)))
    assert within_95_m(error)[0] == pytest.approx(1e-3 * np.sqrt(ELLIPSOID_95), rel=0.05)


def test_a_part_of_the_poses_says_less_than_all() -> None:
    points = recorded().points
    problem = problem_of(ARM, points, Choice())
    at = Conditions(points.q_rad, points.direction, points.payload_kg, points.current_A)
    half = np.arange(len(points)) % 2 == 0
    some, every = (posterior_of(problem, at, Discrepancy(ARM), used) for used in (half, None))
    assert np.trace(some.covariance[:16, :16]) > np.trace(every.covariance[:16, :16])


def test_a_hidden_play_is_what_its_cause_moves_the_tip_by_and_every_source_is_listed() -> None:
    listed = {one.name: one for one in trusted(PLAY).importances}
    for source in Discrepancy(ARM).sources:
        assert listed[source.name].uncertain_m > 0.0, source.name
    tips_m = [ForwardKinematics(ARM).tips(q) for q in (unseen_q(), unseen_q() + np.array([0.0, 0.0, 1e-4]))]
    lever_m = norms(tips_m[1] - tips_m[0]) / 1e-4
    expected_m = 0.5 * PLAY.value * np.sqrt(np.mean(lever_m**2))
    assert listed["joint 3: direction"].expected_m == pytest.approx(expected_m, rel=0.15)
    others = [one.expected_m for name, one in listed.items() if name.startswith("joint") and name != "joint 3: direction"]
    assert max(others) < 0.1 * expected_m


def test_draws_of_a_gear_scatter_about_the_place_that_is_expected_of_it() -> None:
    poses = Conditions.of(unseen_q()[:40])
    drawn = Discrepancy(ARM).strayed(poses, 4000, np.random.default_rng(7))
    assert np.abs(drawn.mean(axis=0)).max() < 5.0 / np.sqrt(4000)
    assert drawn.std(axis=0).max() > 0.5


def test_what_no_pose_shows_is_as_wide_as_its_size_may_be_and_not_as_its_most_probable_one() -> None:
    discrepancy = Discrepancy(ARM)
    count = sum(source.count for source in discrepancy.sources)
    evidence = SizeEvidence(np.zeros((5, 3, 2 + count)), np.zeros((5, 3)), np.full(2, 0.3), discrepancy)
    usual = np.array([1e-4, *(source.usual for source in discrepancy.sources)])
    single = evidence.posterior(np.log(usual))
    wider = evidence.over_sizes(single)
    share = np.exp(-0.5 * (SIZES / SIZE_SPREAD) ** 2)
    factor = float(share @ np.exp(2.0 * SIZES) / share.sum())
    assert factor > 10.0
    assert np.diag(wider.covariance)[2:] == pytest.approx(factor * np.diag(single.covariance)[2:], rel=1e-6)
    assert np.diag(wider.covariance)[:2] == pytest.approx(np.diag(single.covariance)[:2])


def test_averaging_over_sizes_makes_no_direction_more_certain() -> None:
    points = recorded(PLAY).points
    problem, discrepancy = problem_of(ARM, points, Choice()), Discrepancy(ARM)
    at = Conditions(points.q_rad, points.direction, points.payload_kg, points.current_A)
    evidence = SizeEvidence(*linearised(problem, at, discrepancy, np.zeros(16)), np.full(16, 0.3), discrepancy)
    single = evidence.posterior(np.log(np.array([2e-4, *(one.usual for one in discrepancy.sources)])))
    more = evidence.over_sizes(single).covariance - single.covariance
    assert np.linalg.eigvalsh(more).min() > -1e-9 * np.abs(more).max()
    assert np.trace(more) > 0.0


@pytest.mark.parametrize("half_rad", [2.0, 4.0])
def test_the_rest_of_an_angles_error_is_as_alike_as_a_squared_exponential_says(half_rad: float) -> None:
    """To a hundredth of its variance, at 2 lengths and more from the ends of -half .. half, where all of them are 0."""
    x = np.linspace(-0.3 * half_rad, 0.3 * half_rad, 41)
    functions = smooth_functions(x, half_rad)
    alike = np.exp(-0.5 * ((x[:, None] - x) / ANGLE_LENGTH_rad) ** 2)
    assert np.abs(functions @ functions.T - alike).max() < 0.01
