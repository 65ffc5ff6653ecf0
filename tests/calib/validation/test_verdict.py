"""Is my result good? Each answer is given where it is due, with a reason and a next step."""

import dataclasses
from dataclasses import dataclass, field

import numpy as np
import pytest

from calib.arm_problem.assembly import problem_of
from calib.identify.identification import identify
from calib.identify.objective import LeastSquares
from calib.identify.outliers import find_suspects
from calib.points.points import make_points
from calib.validation.holdout import Fold, HeldOut, held_out
from calib.validation.statistics import mean_half_width
from calib.validation.verdict import NoiseFloor, noise_floor, verdict
from tests.calib.simulated import RIGHT, NOISE_m, board_points, true_dh, with_rows
from tests.calib.validation.test_holdout import predicted_by

FLOOR = NoiseFloor(NOISE_m, "the camera's noise in the arm's file")


@dataclass(frozen=True)
class Fitted:
    """What a verdict reads of an identification."""

    error_after_m: np.ndarray
    rank: int = 10
    condition_number: float = 20.0
    estimates: tuple = ()
    nominal_dh: np.ndarray = field(default_factory=lambda: RIGHT.dh)

    @property
    def rms_after_m(self) -> float:
        return float(np.sqrt(np.mean(np.sum(self.error_after_m**2, axis=1))))

    @property
    def mean_after_m(self) -> float:
        return float(np.mean(np.linalg.norm(self.error_after_m, axis=1)))

    @property
    def noise_m(self) -> float:
        return float(np.sqrt(np.sum(self.error_after_m**2) / (self.error_after_m.size - self.rank)))


def fitted(m: int = 99, noise_m: float = NOISE_m, **more) -> Fitted:
    return Fitted(noise_m * np.random.default_rng(0).normal(size=(m, 3)), **more)


def left_out(before_m: float, after_m: float, name: str = 'setup "roll"', m: int = 33) -> HeldOut:
    spread = np.linspace(0.5, 1.5, m)
    return HeldOut("setup", (Fold(name, tuple(range(m)), "error", before_m * spread, after_m * spread),))


@pytest.mark.parametrize(
    ("found", "held", "floor", "grade"),
    [
        (fitted(), left_out(0.02, 0.00025), FLOOR, "good"),
        (fitted(), left_out(0.02, 0.00025), None, "noise not known"),
        (fitted(noise_m=0.0008), left_out(0.02, 0.0015), FLOOR, "not at the floor"),
        (fitted(), left_out(0.02, 0.0015), FLOOR, "over-fitted"),
        (fitted(), left_out(0.002, 0.0021), FLOOR, "worse"),
        (fitted(m=8), left_out(0.02, 0.0003), FLOOR, "too few points"),
        (fitted(), None, FLOOR, "too few points"),
    ],
)
def test_each_case_gets_its_grade(found, held, floor, grade) -> None:
    judgement = verdict(found, held, floor)
    assert judgement.grade == grade
    assert judgement.is_good == (grade == "good")
    assert all(sentence.endswith(".") for sentence in judgement.in_words())


def test_an_effect_that_is_missing_sends_to_the_gap_and_names_the_ratio() -> None:
    judgement = verdict(fitted(noise_m=0.0008), left_out(0.02, 0.0015), FLOOR)
    assert any("armwright gap" in step for step in judgement.next_steps)
    assert any("6.71 times that" in sentence for sentence in judgement.sentences)


def test_the_paper_stands_beside_the_setup_of_the_same_name() -> None:
    text = " ".join(verdict(fitted(), left_out(0.02, 0.00025), FLOOR).sentences)
    assert "roll 98.8 % (paper 28.9 %)" in text
    text = " ".join(verdict(fitted(), left_out(0.02, 0.00025, "part 1 of 5"), FLOOR).sentences)
    assert "paper" not in text
    assert "SpringerPlus" not in text


def test_the_paper_stands_beside_no_other_arm() -> None:
    longer = RIGHT.dh + np.array([0.0, 0.0, 0.05, 0.0])
    for other in (longer, RIGHT.dh[:3], np.vstack((RIGHT.dh, RIGHT.dh))):
        said = " ".join(verdict(fitted(nominal_dh=other), left_out(0.02, 0.00025), FLOOR).sentences)
        assert "SpringerPlus" not in said


def test_a_weak_design_asks_for_free_poses_and_one_board_for_tilts() -> None:
    judgement = verdict(fitted(condition_number=950.0), left_out(0.02, 0.00025), FLOOR, setups=["normal"] * 99)
    assert any("more tilts of the board and a dozen poses away" in step for step in judgement.next_steps)
    assert any('only around the setup "normal"' in sentence for sentence in judgement.sentences)
    assert verdict(fitted(), left_out(0.02, 0.00025), FLOOR, setups=["a", "b"]).next_steps == ()


def test_free_poses_are_told_of_no_board() -> None:
    for fit in (fitted(condition_number=950.0), fitted()):
        judgement = verdict(fit, left_out(0.02, 0.00025), FLOOR, setups=["free"] * 99)
        assert not [line for line in (*judgement.sentences, *judgement.next_steps) if "board" in line or "only around" in line]


def test_a_real_session_from_end_to_end_is_good_and_with_play_it_is_not() -> None:
    rng = np.random.default_rng(1)
    points = board_points(rng, true_dh(rng))
    assert graded(points) == "good"
    q = np.array(points.q_rad) + 0.004 * np.sign(rng.normal(size=(99, 3)))  # either flank of play
    assert graded(with_rows(points, q_rad=q)) == "not at the floor"


def graded(points) -> str:
    problem = problem_of(RIGHT, points)
    identification = identify(problem, objective=LeastSquares(), starts_count=1)
    held = held_out(predicted_by(lambda some: problem_of(RIGHT, some)), points)
    floor = noise_floor(RIGHT, points, problem, identification.x)
    return verdict(identification, held, floor, find_suspects(problem, identification.x), points.setup).grade


def repeated(points, direction, extra_q) -> "np.ndarray":
    """Three times the first ten points, other directions and angles the second time."""
    rows = [*range(10)] * 3
    rng = np.random.default_rng(5)
    q = points.q_rad[rows] + np.repeat([0.0, extra_q, 0.0], 10)[:, None]
    tips = np.asarray(points.tip_m)[rows] + rng.normal(0, NOISE_m, (30, 3))
    names = [points.point[k] for k in rows]
    return make_points(["normal"] * 30, names, np.repeat([1, 2, 3], 10), q, tips, direction=direction)


def test_the_noise_floor_is_the_scatter_of_repeats_or_the_camera_s() -> None:
    rng = np.random.default_rng(2)
    exact = board_points(rng, true_dh(rng), noise_m=0.0)
    problem = problem_of(RIGHT, exact)
    blind = dataclasses.replace(RIGHT, camera=None)
    assert noise_floor(blind, exact, problem, np.zeros(16)) is None
    assert noise_floor(RIGHT, exact, problem, np.zeros(16)).axis_m == RIGHT.camera.position_noise_m
    same = repeated(exact, None, 0.0)
    floor = noise_floor(blind, same, problem_of(RIGHT, same), np.zeros(16))
    assert floor.axis_m == pytest.approx(NOISE_m, rel=0.3)  # 60 degrees of freedom: 9 %
    assert "repeats (60" in floor.source


def test_approaches_from_two_sides_are_no_repeats() -> None:
    rng = np.random.default_rng(3)
    exact = board_points(rng, true_dh(rng), noise_m=0.0)
    sides = np.repeat([[1, 1, 1], [-1, -1, -1], [1, 1, 1]], 10, axis=0).astype(float)
    points = repeated(exact, sides, 0.005)  # play shows as another angle in the same cavity
    floor = noise_floor(dataclasses.replace(RIGHT, camera=None), points, problem_of(RIGHT, points), np.zeros(16))
    assert floor.axis_m == pytest.approx(NOISE_m, rel=0.4)


def test_exact_points_are_not_over_fitted_and_not_good_by_a_noise_that_they_do_not_have() -> None:
    exact = fitted(noise_m=1e-12)
    assert verdict(exact, left_out(0.02, 1e-9), None).grade == "noise not known"
    judgement = verdict(exact, left_out(0.02, 1e-9), FLOOR)
    assert judgement.grade == "noise not known"
    assert "were not measured with it" in " ".join(judgement.sentences)
    assert verdict(fitted(noise_m=1e-5), left_out(0.02, 0.001), None).grade == "over-fitted"


def test_an_arm_is_not_called_good_while_a_joint_of_it_never_moved() -> None:
    judgement = verdict(fitted(), left_out(0.02, 0.00025), FLOOR, still=("q1_rad", "q3_rad"))
    assert judgement.grade == "too few points"
    assert "q1_rad and q3_rad never moved" in " ".join(judgement.sentences)


def test_the_held_out_error_has_its_interval() -> None:
    held = left_out(0.02, 0.00025)
    half = 1e3 * mean_half_width(held.after_m)
    said = " ".join(verdict(fitted(), held, FLOOR).sentences)
    assert f"to 0.250 mm [{0.25 - half:.3f}, {0.25 + half:.3f}] (95 %)" in said
