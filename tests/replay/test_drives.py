"""Recorded drives run through the control code of today, and lead to what they led to when they were recorded."""

from __future__ import annotations

import numpy as np
import pytest

from tests.replay.drives import DRIVES, LAYOUT, Recorded, driven, path_of

EXACT = ("cycle", "run", "mode", "count", "statusword", "drive_faults", "flags", "missed", "page_faults", "switches")
# What the file is rounded to, and what rounding differs by between processors and libraries.
TOLERANCES = {"_rad_s": 2e-6, "_rad": 1e-8, "_V": 1e-3, "_A": 1e-3, "_kg": 1e-6, "_C": 1e-2, "_s": 1e-6, "_m": 1e-6}


@pytest.mark.parametrize("name", DRIVES)
def test_a_recorded_drive_is_driven_as_it_was(name: str) -> None:
    recorded = Recorded.load(path_of(name))
    was, now = recorded.table(), driven(name, recorded.script).table()
    assert len(was) == len(now) > 300
    assert set(recorded.names) <= set(LAYOUT.names)
    for column in recorded.names:
        if column.rstrip("123") in EXACT:
            assert np.array_equal(was[column], now[column]), column
        else:
            tolerance = next(size for unit, size in TOLERANCES.items() if column.endswith(unit))
            np.testing.assert_allclose(now[column], was[column], rtol=0.0, atol=tolerance, err_msg=column)


def test_the_drives_reach_what_they_are_there_for() -> None:
    modes = {name: set(Recorded.load(path_of(name)).table()["mode"].tolist()) for name in DRIVES}
    off, braked, holding, moving, stopping, fault, jogging, paused = 0, 1, 2, 3, 6, 7, 8, 9
    assert modes["move and stop"] >= {braked, holding, moving, stopping}
    assert modes["jog and payload"] >= {holding, jogging}
    assert modes["pause and resume"] >= {moving, paused}
    for name in ("silent encoder", "over-current", "stuck joint"):
        assert modes[name] >= {moving, fault}
    assert off in modes["move and stop"] or braked in modes["move and stop"]


def test_another_byte_from_a_board_is_noticed() -> None:
    """The comparison is worth something: one changed count changes the rows."""
    name = "move and stop"
    recorded = Recorded.load(path_of(name))
    cut = recorded.script[:200] + recorded.script[201:] + recorded.script[-1:]
    was, now = recorded.table(), driven(name, cut).table()
    assert not np.array_equal(was["count1"], now["count1"])
