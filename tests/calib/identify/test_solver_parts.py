"""What the solver is made of: objectives, second derivatives, the step in a box."""

import numpy as np
import pytest

from calib.arrays import SERIAL, norms, slim_product
from calib.errors import CalibrationError
from calib.identify.descent import step_in_box
from calib.identify.objective import HUBER_BEND, LeastSquares, SumOfCoordinates, objective_named, value_of
from calib.identify.solver import WithDistances
from tests.calib.identify.problems import problem_with_everything_free

OBJECTIVES = {
    "e2": objective_named("e2"),
    "e1": objective_named("e1"),
    "lsq": objective_named("lsq"),
    "huber": objective_named("huber", 0.8),
    "lsq with distances": WithDistances(LeastSquares(), 0.7),
    "e1 with distances": WithDistances(SumOfCoordinates(), 0.7),
}
EACH = pytest.mark.parametrize("name", OBJECTIVES)
ARMS = pytest.mark.parametrize("arm", ["reference", "modified"])


@EACH
def test_the_expansion_has_the_derivatives_of_the_value(name) -> None:
    objective, smoothing_m = OBJECTIVES[name], 0.05
    rng = np.random.default_rng(1)
    residuals = rng.normal(size=(6, 3))
    pull, bend = objective.expansion(residuals, smoothing_m, None)
    whole = np.zeros((3, 3, 6))
    whole[[0, 1, 2], [0, 1, 2]] = 1.0
    whole = whole if bend is None else bend if bend.ndim == 3 else whole * bend
    h = 1e-6
    for point in range(6):
        for axis in range(3):
            step = np.zeros((6, 3))
            step[point, axis] = h
            up, down = residuals + step, residuals - step
            slope = (value_of(objective, up, smoothing_m) - value_of(objective, down, smoothing_m)) / (2 * h)
            assert pull[point, axis] == pytest.approx(slope, abs=1e-8)
            turn = (objective.expansion(up, smoothing_m, None)[0] - objective.expansion(down, smoothing_m, None)[0]) / (2 * h)
            np.testing.assert_allclose(whole[:, axis, point], turn[point], atol=1e-7)


@pytest.mark.parametrize("name", ["e2", "e1", "lsq with distances"])
def test_a_dual_keeps_the_curvature_positive(name) -> None:
    """However wrong the dual, the quadratic stays convex; that is what makes every step go down."""
    objective, rng = OBJECTIVES[name], np.random.default_rng(2)
    before, after = rng.normal(size=(50, 3)), 0.01 * rng.normal(size=(50, 3))
    dual = objective.next_dual(before, after, 1e-6, None)
    for columns in (dual[:, :3], dual[:, 3:]):
        lengths = np.abs(columns) if name == "e1" else norms(columns) if columns.size else np.zeros(1)
        assert lengths.max(initial=0.0) <= 1.0 + 1e-12
    _, bend = objective.expansion(after, 1e-6, dual)
    if bend.ndim == 3:
        assert np.linalg.eigvalsh(bend.transpose(2, 0, 1)).min() > -1e-9 * np.abs(bend).max()
    else:
        assert bend.min() >= 0.0


def test_huber_bends_where_least_squares_keep_95_percent_of_their_efficiency() -> None:
    """Efficiency of psi for normal noise in three coordinates: (mean divergence / 3)^2 / (mean |psi|^2 / 3)."""
    s = np.linspace(1e-4, 12.0, 200_001)
    density = np.sqrt(2.0 / np.pi) * s**2 * np.exp(-0.5 * s**2)
    divergence = np.where(s <= HUBER_BEND, 3.0, 2.0 * HUBER_BEND / s)
    psi = np.minimum(s, HUBER_BEND)
    efficiency = (np.trapezoid(divergence * density, s) / 3.0) ** 2 / (np.trapezoid(psi**2 * density, s) / 3.0)
    assert efficiency == pytest.approx(0.95, abs=1e-4)


@pytest.mark.parametrize(
    ("name", "threshold_m", "says"),
    [
        ("l2", None, 'objective "l2": expected one of e2, e1, lsq, huber'),
        ("lsq", 0.001, "only the objective huber has a threshold"),
        ("huber", 0.0, "expected a positive length in m, got 0.0"),
        ("huber", float("nan"), "expected a positive length"),
    ],
)
def test_an_objective_that_makes_no_sense_is_refused(name, threshold_m, says) -> None:
    with pytest.raises(CalibrationError, match=says):
        objective_named(name, threshold_m)


@ARMS
def test_second_derivatives_are_those_of_the_gradient(arm) -> None:
    """DH, tool, boards, base and corrections are all free."""
    rng = np.random.default_rng(3)
    problem = problem_with_everything_free(arm, rng)
    x = rng.uniform(-0.3, 0.3, len(problem.parameters))
    pull = rng.normal(size=(len(problem), 3))
    h = 1e-5  # central differences are then good to some 1e-8 of the largest
    numeric = np.array(
        [
            (problem.expanded(x + h * unit).gradient(pull) - problem.expanded(x - h * unit).gradient(pull)) / (2 * h)
            for unit in np.eye(len(x))
        ]
    )
    np.testing.assert_allclose(problem.expanded(x).curvature(pull), numeric, atol=1e-8 * np.abs(numeric).max())


@ARMS
@pytest.mark.parametrize("form", ["ones", "diagonal", "matrices"])
def test_sums_over_poses_are_those_of_the_jacobian(arm, form) -> None:
    rng = np.random.default_rng(4)
    problem = problem_with_everything_free(arm, rng)
    x = rng.uniform(-0.3, 0.3, len(problem.parameters))
    m = len(problem)
    residuals, jacobian = problem.residuals_and_jacobian(x)
    bend = {"ones": None, "diagonal": rng.uniform(size=(3, m)), "matrices": rng.normal(size=(3, 3, m))}[form]
    whole = np.eye(3)[:, :, None] * (np.ones((3, m)) if bend is None else bend) if form != "matrices" else bend
    gradient, gram = problem.expanded(x).sums(residuals, bend)
    np.testing.assert_allclose(gradient, np.einsum("mi,mik->k", residuals, jacobian), atol=1e-10)
    np.testing.assert_allclose(gram, np.einsum("mik,ijm,mjl->kl", jacobian, whole, jacobian), atol=1e-10)


@pytest.mark.parametrize("n", [5, SERIAL // 12, SERIAL // 12 + 1, SERIAL // 3 + 7])
def test_a_product_in_pieces_is_the_product(n) -> None:
    rng = np.random.default_rng(5)
    left, right = rng.normal(size=(3, n)), rng.normal(size=(4, n))
    np.testing.assert_allclose(slim_product(left, right), left @ right.T, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("k", [1, 8, 40])
@pytest.mark.parametrize("seed", range(12))
def test_the_step_in_a_box_meets_its_optimality_conditions(seed, k) -> None:
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(k, k))
    hessian, gradient = half @ half.T + 1e-3 * np.eye(k), rng.normal(size=k)
    lower, upper = -rng.uniform(0.0, 0.5, k), rng.uniform(0.0, 0.5, k)
    lower[0], upper[-1] = 0.0, 0.0 if k > 1 else upper[-1]
    d = step_in_box(hessian, gradient, lower, upper)
    slope = gradient + hessian @ d
    assert (d >= lower).all()
    assert (d <= upper).all()
    # By the multipliers' signs: inside the slope is 0, at a bound it points out of the box.
    assert np.abs(slope[(d > lower) & (d < upper)]).max(initial=0.0) < 1e-8
    assert (slope[(d == upper) & (d > lower)] <= 1e-8).all()
    assert (slope[(d == lower) & (d < upper)] >= -1e-8).all()


def test_the_step_in_a_box_survives_a_hessian_of_a_narrow_valley() -> None:
    rng = np.random.default_rng(6)
    vectors, _ = np.linalg.qr(rng.normal(size=(12, 12)))
    hessian = (vectors * np.logspace(-10, 0, 12)) @ vectors.T
    gradient = rng.normal(size=12)
    d = step_in_box(hessian, gradient, np.full(12, -1.0), np.full(12, 1.0))
    value = gradient @ d + 0.5 * d @ hessian @ d
    for _ in range(500):
        other = np.clip(d + rng.normal(size=12) * 10.0 ** rng.uniform(-4, 0), -1.0, 1.0)
        assert value <= gradient @ other + 0.5 * other @ hessian @ other + 1e-12
