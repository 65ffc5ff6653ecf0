"""Fixtures of the tests on the gap."""

from __future__ import annotations

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="module")
def without_motion() -> Iterator[None]:
    """Leave out the motion simulated from voltages: it takes no part in naming, and half of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("calib.gap.series.find.motion_gaps", lambda *_: {})
        yield
