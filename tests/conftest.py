"""Fixtures that several packages' tests share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.cell import Cell

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy is imported, as console.main has it


@pytest.fixture(scope="module")
def nobody_below() -> Iterator[None]:
    """A shutdown does not wait until the arm has sunk: for modules whose claims are others."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("control.loop.standstill.SINK_LIMIT_S", 0.6)
        yield


@pytest.fixture
def cell() -> Iterator[Cell]:
    """A stretched, homed arm that is held; see tests/cell.py."""
    from tests.cell import holding_cell  # MuJoCo takes a second to import: not for tests that need no plant

    with holding_cell() as held:
        yield held
