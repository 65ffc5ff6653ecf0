"""The journeys, each on the arms that its page names: those `At each change` here, all by `make journeys` and at night."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.journeys.runner import JOURNEYS, walk

WALKS = [
    pytest.param(name, arm, marks=[] if arm in journey.arms("At each change") else pytest.mark.nightly)
    for name, journey in JOURNEYS.items()
    for arm in journey.arms()
]


@pytest.mark.realtime
@pytest.mark.parametrize(("name", "arm"), WALKS)
def test_the_journey_comes_to_its_end(name: str, arm: str, tmp_path: Path) -> None:
    walk(JOURNEYS[name], arm, tmp_path)
