"""A linearisation: what stays from an earlier one brings no coefficients, and frames are averaged without a change of noise."""

from __future__ import annotations

import copy
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calib.gap.finding import EffectName
from calib.gap.posterior.evidence import Gram
from calib.gap.residuals.rows import ChannelRows
from calib.gap.residuals.scene import Columns, OperatingPoint, Product, SeriesTerm, Thin
from calib.gap.series.linear import Marginal, SeriesLinear
from calib.gap.signals.terms import Law

ROWS = 6
COULOMB = EffectName("coulomb_friction", 1)


def around(found: dict[Any, Law]) -> OperatingPoint:
    run, sample = np.zeros(ROWS, dtype=int), np.arange(ROWS)
    cell = ChannelRows("current_A", 0, slice(0, ROWS), 1.0)
    scene: Any = SimpleNamespace(cells=(cell,), thinned=[Thin.each(run, sample, 1)])
    rows = np.linspace(-1.0, 1.0, ROWS)
    return OperatingPoint(scene, (), found, rows, rows)


def term() -> SeriesTerm:
    response = {0: np.ones((ROWS, 1))}
    return SeriesTerm(COULOMB, response=response, now=np.array([3.0]))


def test_only_what_the_model_has_is_added_to_what_it_leaves() -> None:
    law = Law(COULOMB, "coulomb_friction", (3.0,))
    has, has_not = around({COULOMB: law}), around({})
    np.testing.assert_allclose(SeriesLinear.around(has, [term()]).y, 3.0 - has.residual)
    np.testing.assert_allclose(SeriesLinear.around(has_not, [term()]).y, -has_not.residual)


def test_averaged_frames_keep_their_noise_and_do_not_reach_over_a_gap() -> None:
    frames = np.concatenate([np.arange(0, 35, 5), np.arange(100, 2800, 5)])  # seven, a gap, many
    run, sample = np.zeros(3 * len(frames), dtype=int), np.repeat(frames, 3)
    thin = Thin.of_frames(run, sample, 5, 3)
    assert thin.sample[:9:3].tolist() == [5, 20, 105]
    noise = np.random.default_rng(1).normal(size=len(sample))
    assert np.std(thin.of(noise)) == pytest.approx(1.0, rel=0.1)
    columns = Columns((noise[:, None], np.arange(len(sample))[:, None] * [2.0, 3.0]))
    np.testing.assert_allclose(thin.rows(columns, slice(7, 30)), thin.of(columns[:])[7:30], rtol=1e-12)
    assert not thin.all_of(np.arange(len(sample)) > 0)[0]
    assert thin.all_of(np.arange(len(sample)) > 0)[1:].all()


def test_rows_of_products_are_those_of_all_of_them() -> None:
    rng = np.random.default_rng(6)
    of, shapes, own = rng.normal(size=(12, 2)), rng.normal(size=(3, 4)), rng.normal(size=(2, 4))
    picked, size = np.array([0, 1, 3, 5]), rng.uniform(1.0, 2.0, 4)
    every = [of[:, law] * np.repeat(shape, 3) for shape in shapes for law in (0, 1)]
    expected = (np.stack(every, axis=1)[:, picked] - of @ own) * size
    product = Product(of, shapes, 3, picked, own, size)
    side_by_side = Columns((of, product))
    assert side_by_side.shape == (12, 6)
    for rows in (slice(None), slice(2, 9), slice(5, 5)):
        np.testing.assert_allclose(product[rows], expected[rows], rtol=1e-12)
        np.testing.assert_allclose(side_by_side[rows], np.hstack((of, expected))[rows], rtol=1e-12)
    np.testing.assert_allclose(side_by_side @ np.ones(6), of.sum(axis=1) + expected.sum(axis=1))


def test_departures_count_by_what_they_do_together_beside_the_law_where_it_shows() -> None:
    rng = np.random.default_rng(3)
    law, bend = rng.normal(size=(2, 400))
    law, bend = law / np.linalg.norm(law), bend / np.linalg.norm(bend)
    near = bend + 0.05 * law
    columns = np.column_stack((law, bend, near / np.linalg.norm(near), 0.0 * law))
    faint = np.column_stack((0.02 * law, 0.0 * law, 0.0 * law, 0.02 * bend))
    term = SeriesTerm(COULOMB, departures=3, response={0: 30.0 * columns, 1: 30.0 * faint})
    assert term.departed_by(np.array([2.0, 0.8, -0.8, 0.0])) < 0.05  # they take each other's place
    assert term.departed_by(np.array([2.0, 0.4, 0.4, 0.0])) == pytest.approx(0.4, rel=0.01)
    assert term.departed_by(np.array([-2.0, 0.8, 0.0, 0.0])) == pytest.approx(0.4, rel=0.01)
    assert term.departed_by(np.array([2.0, 0.0, 0.0, 1.0])) < 0.05  # where the law hardly shows


@pytest.mark.parametrize("first", [0, 3])
@pytest.mark.parametrize("is_told", [False, True])
def test_what_was_integrated_out_comes_back_beside_any_of_the_others(first: int, is_told: bool) -> None:
    rng = np.random.default_rng(8)
    columns, y = rng.normal(size=(40, 8)), rng.normal(size=40)
    told, pull = np.zeros((8, 8)), np.zeros(8)
    if is_told:
        told[6:, 6:], pull[6:] = [[3.0, 1.0], [1.0, 2.0]], 0.5
    gram = Gram(columns.T @ columns, columns.T @ y, told if is_told else None, pull, float(y @ y), 40.0)
    marginal, others = Marginal.of(copy.deepcopy(gram), first), np.array([7, 4, 6])
    variance = np.eye(40) + columns[:, :first] @ columns[:, :first].T
    rest = columns[:, first:]
    np.testing.assert_allclose(marginal.apart.tip, rest.T @ np.linalg.solve(variance, rest), atol=1e-9)
    np.testing.assert_allclose(marginal.apart.pull, rest.T @ np.linalg.solve(variance, y), atol=1e-9)
    assert marginal.apart.left == pytest.approx(y @ np.linalg.solve(variance, y))
    every = slice(None)
    for with_first, at in ((True, np.concatenate((np.arange(first), others))), (False, others)):
        of, expected = marginal.beside(others, with_first), gram.of(at)
        np.testing.assert_allclose(of.among(every, every, 1.3), expected.among(every, every, 1.3), atol=1e-9)
        np.testing.assert_allclose(of.drawn(every, 1.3), expected.drawn(every, 1.3), atol=1e-9)
        assert of.left == pytest.approx(gram.left)
