"""The log evidence of sets of columns: against its definition, and where the numbers are hard."""

import numpy as np
import pytest

from calib.gap.poses.evidence import Evidence


def marginal(columns: np.ndarray, base: np.ndarray, y: np.ndarray) -> float:
    """Ln p(y) of y = A b + C s + noise with N(0, I) throughout: y ~ N(0, I + A A' + C C')."""
    covariance = np.eye(len(y)) + base @ base.T + columns @ columns.T
    return -0.5 * float(y @ np.linalg.solve(covariance, y) + np.linalg.slogdet(covariance)[1])


@pytest.mark.parametrize("chosen", [(), (0,), (2,), (0, 1), (0, 1, 2, 3)])
def test_it_is_the_marginal_likelihood_over_that_of_the_empty_set(chosen: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    base, columns, y = rng.normal(size=(40, 5)), rng.normal(size=(40, 4)), rng.normal(size=40)
    evidence = Evidence.of(base, columns, y)
    wanted = marginal(columns[:, list(chosen)], base, y) - marginal(columns[:, []], base, y)
    assert evidence.log(chosen) == pytest.approx(wanted, abs=1e-9)
    assert evidence.log_each([chosen])[0][0] == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize("size", [1.0, 1e6, 1e9])
def test_large_columns_that_the_base_explains_are_worth_nothing_and_no_error(size: float) -> None:
    rng = np.random.default_rng(2)
    base = size * rng.normal(size=(60, 4))
    columns = base @ rng.normal(size=(4, 6))
    y = rng.normal(size=60)
    evidence = Evidence.of(base, columns, y)
    assert np.linalg.eigvalsh(evidence.gram).min() > -1e-6
    assert evidence.log(range(6)) < 0.5
    assert np.isfinite(evidence.log_each([range(6)])[0]).all()
