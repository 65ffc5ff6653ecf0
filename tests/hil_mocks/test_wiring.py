"""What is plugged where, as the mock draws it."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import pytest

from control.model.description import load_arm
from control.model.drive import Home
from hil_mocks.scenario import load_scenario
from hil_mocks.wiring import wiring_of


@pytest.mark.parametrize(("index_rad", "is_above"), [(-0.1, True), (-0.05, True), (-0.15, False)])
def test_a_home_switch_is_active_on_the_side_that_the_file_says_whatever_is_drawn(index_rad: float, is_above: bool) -> None:
    right = load_arm("right")
    home = Home(switch_rad=-0.1, index_rad=index_rad)
    arm = replace(right, drives=tuple(replace(drive, home=home) for drive in right.drives))
    for seed in range(10):
        for wired in wiring_of(arm, msgspec.structs.replace(load_scenario("demo"), seed=seed)):
            assert wired.is_at_switch(0.3) is is_above
            assert wired.is_at_switch(-0.5) is not is_above
