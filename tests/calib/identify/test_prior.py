"""How exactly parts are made, known beforehand, counts beside the points: [tolerances] of arm.toml."""

import dataclasses
import math
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from armwright import make_points
from benchmarks.calibration.chains import REFERENCE, REFERENCE_DH
from calib.arm_problem.arm_model import ArmModel, Bounds
from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.joint_effects import made_effects
from calib.arm_problem.parallel_axes import with_tilt_behind
from calib.arrays import norms
from calib.calibration import CalibrationPlan, calibrate, calibrated_arm, identified, with_made_effects
from calib.gap.finding import with_totals
from calib.gap.poses.find import find
from calib.identify.descent import descend
from calib.identify.identification import identify
from calib.identify.objective import Huber, LeastSquares, Objective, SumOfCoordinates, SumOfDistances
from calib.identify.solver import prior_of
from calib.points.points import Points
from control.dynamics.static_pose import resting
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Camera, Effect
from control.model.description import arm_text, load_arm, parse_arm
from control.model.effects import backlash_rad
from control.model.tolerances import ArmTolerances, JointTolerances, LinkTolerances, Spread
from tests.calib.arms import arm_of
from tests.journeys.truth import true_arm

LENGTH_m, ANGLE_rad, NOISE_m = 4e-4, 5e-3, 1e-3
LINKS = LinkTolerances(Spread(sd=LENGTH_m), Spread(sd=ANGLE_rad), Spread(sd=LENGTH_m), Spread(sd=ANGLE_rad))
ARM = dataclasses.replace(arm_of(REFERENCE, REFERENCE_DH), tolerances=ArmTolerances(every_link=LINKS))
BASE = Choice(fixed=("base",))
SO101, KOCH, PLAY_rad = load_arm("so101"), load_arm("koch"), math.radians(0.8)
LSQ = CalibrationPlan(BASE, LeastSquares(), starts_count=1)


def made(arm: Arm, seed: int, times: float = 1.0) -> tuple[Arm, np.random.Generator]:
    """An arm as its tolerances say that arms are made."""
    rng, model = np.random.default_rng(seed), ArmModel(arm)
    return dataclasses.replace(arm.with_dh(arm.dh + times * model.made_sd * rng.standard_normal((len(arm.links), 4)))), rng


def measured(true: Arm, rng: np.random.Generator, count: int, noise_m: float = NOISE_m) -> Points:
    q = rng.uniform(-1.2, 1.2, (count, true.joint_count))
    return make_points(q, ForwardKinematics(true).tips(q) + rng.normal(0.0, noise_m, (count, 3)))


def off_m(arm: Arm, true: Arm) -> float:
    """Root mean square of the tip's error over the range."""
    q = np.random.default_rng(9).uniform(-1.2, 1.2, (200, arm.joint_count))
    return float(np.sqrt(np.mean(norms(ForwardKinematics(arm).tips(q) - ForwardKinematics(true).tips(q)) ** 2)))


def geometry(arm: Arm, points: Points, plan: CalibrationPlan = LSQ) -> Arm:
    return calibrated_arm(arm, identified(arm, points, plan)[1])


def test_least_squares_give_the_most_probable_arm() -> None:
    """The gradient of |r|^2 / 2 v + sum of (x / s)^2 / 2 is zero, v the variance that the fit leaves."""
    true, rng = made(ARM, 1)
    problem = problem_of(ARM, measured(true, rng, 20), BASE)
    fit = identify(problem, objective=LeastSquares())
    residual, jacobian = problem.residuals_and_jacobian(fit.x)
    sd = np.array([parameter.sd / parameter.scale for parameter in problem.parameters])
    pulls = np.einsum("mi,mik->k", residual, jacobian) / fit.noise.variance_m2, fit.x / sd**2
    assert pulls[0] == pytest.approx(-pulls[1], abs=0.03 * np.abs(pulls[1]).max())  # v settles to two per cent
    assert fit.noise.variance_m2 == pytest.approx(NOISE_m**2, rel=0.4)  # of 60 coordinates, some ten of them used
    deviation = np.array([estimate.deviation / estimate.parameter.sd for estimate in fit.estimates])
    spread = np.array([estimate.sd / estimate.parameter.sd for estimate in fit.estimates])
    assert np.abs(deviation).max() < 3.0
    assert (spread <= 1.0).all()  # of what nobody measures, what is known beforehand is left
    assert spread.max() > 0.9


@pytest.mark.parametrize("objective", [SumOfDistances(), SumOfCoordinates(), Huber()], ids=["E2", "E1", "Huber"])
def test_every_objective_weighs_the_prior_as_least_squares_do(objective: Objective) -> None:
    true, rng = made(ARM, 2)
    points = measured(true, rng, 40)
    ours = geometry(ARM, points, dataclasses.replace(LSQ, objective=objective))
    theirs = geometry(ARM, points)
    # both scatter about the truth by some sd; a prior of another weight would lead the whole arm to or from nominal
    sd = ArmModel(ARM).made_sd
    shrunk = [np.sum(((arm.dh - ARM.dh) / sd) ** 2) for arm in (ours, theirs)]
    assert shrunk[0] == pytest.approx(shrunk[1], rel=0.35)


@pytest.mark.parametrize("times", [0.3, 1.0])
def test_few_rough_points_do_not_make_a_well_made_arm_worse(times: float) -> None:
    without, after, before = [], [], []
    for seed in range(6):
        true, rng = made(ARM, seed, times)
        points = measured(true, rng, 8, 2e-3)
        before.append(off_m(ARM, true))
        after.append(off_m(geometry(ARM, points), true))
        without.append(off_m(geometry(dataclasses.replace(ARM, tolerances=None), points), true))
    assert np.mean(after) < 1.1 * np.mean(before)  # six arms: a tenth is chance
    assert np.mean(after) < 0.8 * np.mean(without)


def test_many_exact_points_find_an_arm_that_is_made_badly() -> None:
    true, rng = made(ARM, 5)
    dh = np.array(true.dh)
    dh[1, 2] += 3.0 * LENGTH_m
    true = true.with_dh(dh)
    assert off_m(geometry(ARM, measured(true, rng, 200, 2e-5)), true) < 2e-5


def test_the_bound_is_the_usual_one_or_four_standard_deviations_unless_the_operator_says_another() -> None:
    points = measured(*made(ARM, 1), 10)
    rough = dataclasses.replace(ARM, tolerances=ArmTolerances(every_link=LinkTolerances(L_m=Spread(sd=0.003))))
    bounds, rough_bounds = ({one.name: one.bound for one in problem_of(arm, points, BASE).parameters} for arm in (ARM, rough))
    assert (bounds["L2"], rough_bounds["L2"]) == pytest.approx((0.005, 0.012))
    told = problem_of(ARM, points, dataclasses.replace(BASE, bounds=Bounds(length_m=0.002))).parameters
    assert {one.name: one.bound for one in told}["L2"] == 0.002


def test_a_zero_is_as_exact_as_link_and_joint_together() -> None:
    tolerances = ArmTolerances(every_link=LINKS, joint={"2": JointTolerances(encoder_zero_rad=Spread(within=0.03, mean=0.01))})
    model = ArmModel(dataclasses.replace(ARM, tolerances=tolerances))
    assert model.made_sd[0, 1] == ANGLE_rad
    assert model.made_sd[1, 1] == pytest.approx(math.hypot(ANGLE_rad, 0.03 / math.sqrt(3.0)))
    assert model.made_dh[1, 1] - ARM.dh[1, 1] == pytest.approx(0.01)


def test_calibrated_again_an_arm_is_still_held_to_what_was_published() -> None:
    true, rng = made(ARM, 3)
    points = measured(true, rng, 12, 2e-3)
    once = geometry(ARM, points)
    read = parse_arm(arm_text(once), Path("once.toml"))
    again = geometry(read, points)
    moved = norms(once.dh - ARM.dh).max()
    assert norms(again.dh - once.dh).max() < 0.1 * moved  # with a prior about the last file it goes on by half as much again
    assert again.tolerances == once.tolerances


def test_a_tilted_axis_takes_the_published_rows_along() -> None:
    right = load_arm("right")
    tolerances = ArmTolerances(every_link=LINKS, link={"3": LinkTolerances(L_m=Spread(sd=1e-3))})
    arm = dataclasses.replace(right, tolerances=tolerances).with_dh(right.dh + 1e-4)
    more = with_tilt_behind(arm, 2)
    assert more.tolerances is not None
    assert (list(more.tolerances.link), len(more.tolerances.about)) == (["4"], len(more.links))
    bare = with_tilt_behind(dataclasses.replace(right, tolerances=None), 2)
    assert np.array(more.tolerances.about) == pytest.approx(bare.dh)


def loose(arm: Arm, seed: int, small: float, play_rad: float = PLAY_rad) -> tuple[Points, Points]:
    """Points of an arm whose gears have play, and the truth in other poses: as its model of gears at rest has it."""
    true, rng = made(dataclasses.replace(arm, tolerances=None) if small == 0.0 else arm, seed, small)
    lower, upper = np.array(arm.limits_rad).T
    q = rng.uniform(0.8 * lower, 0.8 * upper, (110, arm.joint_count))
    q[:, 1] = rng.uniform(-0.9, 0.9, len(q))
    direction = rng.choice((-1.0, 1.0), q.shape)
    flank = resting(arm, q, direction).flank
    lying = np.where(flank == 0.0, rng.uniform(-1.0, 1.0, q.shape), flank)
    tip_m = ForwardKinematics(true).tips(q + backlash_rad(lying, play_rad))
    noisy = tip_m + rng.normal(0.0, 5e-4, tip_m.shape)
    fitted, others = make_points(q, noisy, direction=direction), make_points(q, tip_m, direction=direction)
    return fitted.chosen(range(40)), others.chosen(range(40, 110))


def mean_off_m(arm: Arm, points: Points) -> float:
    problem = problem_of(arm, points, BASE)
    return float(np.mean(norms(problem.residuals(np.zeros(len(problem.parameters))))))


def test_an_so101_of_small_errors_gets_better_although_its_gears_have_play() -> None:
    fitted, others = loose(SO101, 1, 0.5)
    bare = dataclasses.replace(SO101, tolerances=None)
    lengths = tuple(f"{key}{row}" for row in range(1, len(SO101.links) + 1) for key in ("d", "L", "alpha"))
    zeros = geometry(bare, fitted, dataclasses.replace(LSQ, choice=Choice(fixed=("base", *lengths))))
    plan = dataclasses.replace(LSQ, choice=with_made_effects(BASE, SO101))
    calibrated = geometry(SO101, fitted, plan)
    published_m, zeros_m, calibrated_m = (mean_off_m(arm, others) for arm in (SO101, zeros, calibrated))
    assert calibrated_m < 0.5 * min(published_m, zeros_m, mean_off_m(geometry(bare, fitted), others))
    widths = [effect.parameters["width_rad"] for effect in calibrated.effects if effect.effect == "backlash"]
    assert np.median(widths) == pytest.approx(PLAY_rad, rel=0.25)


def test_only_what_tolerances_say_is_identified_unasked() -> None:
    assert made_effects(SO101) == tuple(f"backlash:{joint}" for joint in range(1, 6))
    assert with_made_effects(Choice(effects=("backlash:2",)), SO101).effects[0] == "backlash:2"
    assert len(with_made_effects(Choice(effects=("backlash:2",)), SO101).effects) == 5
    assert with_made_effects(BASE, load_arm("right")) == dataclasses.replace(BASE, fixed=["base"])
    without = with_made_effects(Choice(fixed=("L2", "backlash2")), SO101)
    assert (len(without.effects), without.fixed, "backlash:2" in without.effects) == (4, ["L2"], False)


def test_play_of_an_arm_without_masses_is_told_and_left_out() -> None:
    links = tuple(dataclasses.replace(link, mass_kg=None, com_m=None, inertia_kg_m2=None) for link in SO101.links)
    bare = dataclasses.replace(SO101, links=links)
    assert made_effects(bare) == ()
    result = calibrate(bare, loose(SO101, 1, 0.5)[0], dataclasses.replace(LSQ, choice=BASE))
    assert any("no play is identified; add mass_kg" in warning for warning in result.warnings)
    assert "backlash" not in {effect.effect for effect in result.arm.effects}


def test_gap_takes_no_play_away_that_tolerances_say_is_there_and_identifies_it_as_calibrate_does() -> None:
    """A play that was identified in a file, and is hardly there any more, as gears have been adjusted."""
    arm = dataclasses.replace(SO101, camera=Camera(position_noise_m=5e-4))
    fitted, _ = loose(arm, 0, 0.5, play_rad=0.0035)
    calibrated = geometry(arm, fitted, dataclasses.replace(LSQ, choice=with_made_effects(BASE, arm)))
    given = with_totals(calibrated, [Effect("backlash", 2, {"width_rad": 0.02})])
    found = find(given, fitted)
    assert not [effect.name for effect in found.finding.effects if effect.is_nothing]
    widths = [effect.parameters["width_rad"] for effect in found.file.effects if effect.effect == "backlash"]
    assert len(widths) == 5
    assert widths[1] == pytest.approx(0.0035, abs=0.005)


@pytest.mark.parametrize(("count", "seed"), [(13, 0), (14, 1)])
def test_noise_that_goes_to_and_fro_is_found_in_a_few_fits(count: int, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Taken as the next one, the noise that few points leave needs 32 and 25 fits."""
    fits = Mock(wraps=descend)
    monkeypatch.setattr("calib.identify.solver.descend", fits)
    true, rng = made(SO101, seed)
    q = rng.uniform(*0.9 * np.array(SO101.limits_rad).T, (count, SO101.joint_count))
    points = make_points(q, ForwardKinematics(true).tips(q) + rng.normal(0.0, 5e-4, (count, 3)))
    problem = problem_of(SO101, points, BASE)
    assert prior_of(problem, SumOfDistances()) is not None
    assert fits.call_count <= 12


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_exact_points_of_parts_that_are_worse_than_their_tolerances_are_believed(seed: int) -> None:
    """Lengths off by up to 3.5 mm where the file says 0.5, measured to 0.14 mm: seen from nominal, all of that is noise."""
    rng, (lower, upper) = np.random.default_rng(seed), 0.9 * np.array(KOCH.limits_rad).T
    true = ForwardKinematics(true_arm(KOCH, "demo"))
    q = rng.uniform(lower, upper, size=(60, KOCH.joint_count))
    seen = make_points(q[:24], true.tips(q[:24]) + rng.normal(0.0, 1.4e-4, (24, 3)))
    plan = dataclasses.replace(LSQ, choice=with_made_effects(BASE, KOCH))
    published_m, calibrated_m = (
        norms(ForwardKinematics(arm).tips(q[24:]) - true.tips(q[24:])).mean() for arm in (KOCH, geometry(KOCH, seen, plan))
    )
    assert calibrated_m < 0.1 * published_m
