"""The five observability indices, against their definitions worked out by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.design.information import NAMES, indices_of

SINGULAR = st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=12)


def test_indices_of_three_singular_values_are_those_worked_out_by_hand():
    indices = indices_of(np.array([8.0, 4.0, 2.0]), poses_count=16)
    assert indices.o1 == pytest.approx(4.0 / 4.0)  # cube root of 64 over the root of 16
    assert indices.o2 == pytest.approx(0.25)
    assert indices.o3 == pytest.approx(2.0)
    assert indices.o4 == pytest.approx(0.5)
    assert indices.o5 == pytest.approx(1.0 / (1 / 8 + 1 / 4 + 1 / 2))
    assert tuple(indices.as_dict()) == NAMES


@given(SINGULAR, st.floats(0.1, 10.0))
def test_all_but_o2_grow_in_proportion_when_the_noise_shrinks(singular, factor):
    before = indices_of(np.array(singular), 5).as_dict()
    after = indices_of(factor * np.array(singular), 5).as_dict()
    for name in NAMES:
        assert after[name] == pytest.approx(before[name] * (1.0 if name == "O2" else factor))


@given(SINGULAR)
def test_order_of_the_singular_values_does_not_matter(singular):
    assert indices_of(np.array(singular), 3) == indices_of(np.array(singular[::-1]), 3)


@pytest.mark.parametrize("singular", [[], [3.0, 0.0], [0.0]])
def test_what_is_not_determined_makes_every_index_zero(singular):
    assert set(indices_of(np.array(singular), 4).as_dict().values()) == {0.0}


def test_no_pose_has_no_observability():
    assert set(indices_of(np.array([1.0]), 0).as_dict().values()) == {0.0}
