"""The journeys, each on the arms that its page names: those `At each change` here, all by `make journeys` and at night."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.journeys.runner import JOURNEYS, Journey, Stumble, walk

WALKS = [
    pytest.param(name, arm, marks=[] if arm in journey.arms("At each change") else pytest.mark.nightly)
    for name, journey in JOURNEYS.items()
    for arm in journey.arms()
]


@pytest.mark.realtime
@pytest.mark.parametrize(("name", "arm"), WALKS)
def test_the_journey_comes_to_its_end(name: str, arm: str, tmp_path: Path) -> None:
    walk(JOURNEYS[name], arm, tmp_path)


def test_a_command_is_interrupted_once_it_has_said_the_words_and_says_the_rest_after_it(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        """\
    $ trap 'echo left; exit 130' INT; echo begun; while :; do sleep 0.1; done # status 130
    begun
    > ^C
    left
""",
        encoding="utf-8",
    )
    folder = tmp_path / "walked"
    assert walk(Journey(page), "three", folder).answers == 0
    page.write_text(page.read_text(encoding="utf-8").replace("    left", "    ended"), encoding="utf-8")
    with pytest.raises(Stumble, match=r"page\.md:1: .*\n.*\nbegun\nended\ngot\nbegun\nleft"):
        walk(Journey(page), "three", tmp_path / "stumbled")
