"""What other recordings tell: as if all had been weighed at once, told once, in the file's totals or beside them."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from calib.gap.effects.catalogue import SHARED
from calib.gap.finding import EffectName
from calib.gap.posterior.evidence import Evidence, Gram, Weighed
from calib.gap.posterior.term import Block, Term
from calib.gap.posterior.told import Told
from control.model.arm import Effect
from control.model.description import load_arm

SCALES = tuple(EffectName("encoder_scale", joint) for joint in (1, 2, 3))
OWN = Block(2, "what only one of them has")
SIZE = 0.005
ROWS = 200


def _term(key: EffectName | Block, **more: Any) -> Term:
    size = SIZE if isinstance(key, EffectName) else 1.0
    return Term(key, str(key), size=size, slope_rad=np.zeros((1, 1, 1)), **more)


def _gram(columns: np.ndarray, y: np.ndarray) -> Gram:
    return Gram(columns.T @ columns, columns.T @ y, None, np.zeros(columns.shape[1]), float(y @ y), float(len(y)))


@pytest.fixture(scope="module")
def recordings() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Columns and values of two: the first two scales are hard to tell apart in the first; the second has a shape of its own."""
    rng = np.random.default_rng(3)
    one, two = rng.normal(size=(ROWS, 3)), rng.normal(size=(ROWS, 4))
    one[:, 1] = one[:, 0] + 0.05 * one[:, 1]
    two[:, 3] += two[:, 2]
    truth = np.array([0.0, 0.4, 0.1])
    return (one, one @ truth + rng.normal(size=ROWS), two, two @ np.append(truth, 0.7) + rng.normal(size=ROWS))


@pytest.fixture(scope="module")
def told(recordings: tuple[np.ndarray, ...]) -> Told:
    *_, columns, y = recordings
    evidence = Evidence(_gram(columns, y), [*map(_term, SCALES), _term(OWN)], 0.03)
    return Told.by(evidence, Weighed(((3, 2),), 1.0, 0.0), SHARED)


SETS = [[(1, 2)], [(0, 3)], [(0, 3), (1, 1)], [(2, 1)], [(0, 2), (1, 3), (2, 0)]]


@pytest.mark.parametrize("members", SETS)
def test_a_set_is_weighed_as_if_all_recordings_were_one(members, recordings, told: Told) -> None:
    one, y, two, also = recordings
    terms = [_term(key) for key in SCALES]
    places = [np.array([k]) for k in range(3)]
    beside = Evidence(told.beside(_gram(one, y), terms, places), terms, 0.03)
    stacked = np.vstack((np.column_stack((one, np.zeros(ROWS))), two))
    whole = Evidence(_gram(stacked, np.concatenate((y, also))), [*terms, _term(OWN)], 0.03)
    own = [(3, 2)]
    gained = whole.value([*members, *own], 1.0) - whole.value(own, 1.0)
    assert beside.value(members, 1.0) - beside.value([], 1.0) == pytest.approx(gained, abs=1e-8)
    means, covariances = zip(beside.estimate(members, 1.0), whole.estimate([*members, *own], 1.0), strict=True)
    count = len(members)
    np.testing.assert_allclose(means[0], means[1][:count], atol=1e-10)
    np.testing.assert_allclose(covariances[0], covariances[1][:count, :count], atol=1e-10)


def test_of_what_was_withdrawn_nothing_is_told(recordings) -> None:
    *_, columns, y = recordings
    evidence = Evidence(_gram(columns, y), [*map(_term, SCALES), _term(OWN)], 0.03)
    told = Told.by(evidence, Weighed(((2, 3), (3, 2)), 1.0, 0.0), SHARED, withdrawn={SCALES[2]})
    assert SCALES[2] not in told.places
    assert SCALES[2] not in told.found
    free = Told.by(evidence, Weighed(((3, 2),), 1.0, 0.0), SHARED)
    spread = free.information + np.diag([0.0, 0.0, (SIZE * evidence.scales[2][0][3][0]) ** -2.0])
    np.testing.assert_allclose(np.linalg.inv(told.information), np.linalg.inv(spread)[:2, :2], rtol=1e-9)


def test_what_recordings_lean_to_is_told_and_not_said_to_be_found(recordings) -> None:
    *_, columns, y = recordings
    evidence = Evidence(_gram(columns, y), [*map(_term, SCALES), _term(OWN)], 0.03)
    told = Told.by(evidence, Weighed(((2, 3), (3, 2)), 1.0, 0.0), SHARED)
    assert told.places.keys() == set(SCALES)
    assert told.found == {SCALES[2]}


def test_what_was_told_is_not_told_back(recordings, told: Told) -> None:
    one, y, *_ = recordings
    terms = [_term(key) for key in SCALES]
    places = [np.array([k]) for k in range(3)]
    best = Weighed((), 1.0, 0.0)
    alone = Told.by(Evidence(_gram(one, y), terms, 0.03), best, SHARED)
    whole = Evidence(told.beside(_gram(one, y), terms, places), terms, 0.03)
    back = Told.by(whole, best, SHARED, told)
    np.testing.assert_allclose(back.information, alone.information, rtol=1e-9)
    np.testing.assert_allclose(back.pull, alone.pull, rtol=1e-9)


def test_what_a_law_may_hide_widens_its_size_alone(told: Told) -> None:
    more = np.array([[4e-6]])
    wider = told.widened(SCALES[1], more)
    before, after = (np.linalg.inv(one.information) for one in (told, wider))
    added = np.zeros((3, 3))
    added[1, 1] = more[0, 0]
    np.testing.assert_allclose(after, before + added, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(after @ wider.pull, before @ told.pull, rtol=1e-9)


def test_a_change_is_the_total_without_what_the_file_has(told: Told) -> None:
    known = Effect("encoder_scale", 2, {"scale": 0.0015})
    arm = dataclasses.replace(load_arm("right"), effects=(known,))
    changes = told.beyond(arm)
    before, after = (np.linalg.solve(one.information, one.pull) for one in (told, changes))
    np.testing.assert_allclose(before - after, [0.0, 0.0015, 0.0], atol=1e-12)
    np.testing.assert_allclose(changes.beyond(arm, -1.0).pull, told.pull, rtol=1e-12)


def test_the_recording_that_knows_an_effect_better_is_said(recordings, told: Told) -> None:
    one, y, *_ = recordings
    other = Told.by(Evidence(_gram(one, y), [_term(key) for key in SCALES], 0.03), Weighed((), 1.0, 0.0), SHARED)
    assert told.knows_better(SCALES[1], other)
    assert other.knows_better(SCALES[2], told)  # the second one's own shape looks like this scale
    assert not told.knows_better(EffectName("backlash", 1), other)  # of which neither knows


def test_sizes_that_no_arm_can_have_at_once_are_told_apart(told: Told) -> None:
    changed = dataclasses.replace(told, pull=told.pull + told.information @ np.array([0.0, 0.004, 0.0]))
    assert told.differs_from(changed, SCALES[1])
    assert not told.differs_from(told, SCALES[1])
    assert "scale 0.00" in changed.words(SCALES[1])
