"""A linearisation: what stays from an earlier one brings no coefficients, and frames are averaged without a change of noise."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calib.gap.finding import EffectName
from calib.gap.residuals.rows import ChannelRows
from calib.gap.residuals.scene import OperatingPoint, SeriesTerm, Thin
from calib.gap.series.linear import SeriesLinear
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
    assert not thin.all_of(np.arange(len(sample)) > 0)[0]
    assert thin.all_of(np.arange(len(sample)) > 0)[1:].all()


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
