"""The console of a cell: a screen an arm, one stop for all."""

from __future__ import annotations

import argparse
import asyncio
from pathlib import Path

import pytest

from console.commands.console import _of_cell
from console.screen.app import ArmAtDesk
from control.errors import ArmError
from control.safety.modes import Mode
from tests.cell import scenario
from tests.console.screen.console_rig import Served, console_of, files_in, press, shown, until
from tests.pair import APART, FREE, PAIR, Pair, holding_pair


async def operated(pair: Pair, folder: Path) -> None:
    served = Served(pair, folder, PAIR.names)
    stations = [
        ArmAtDesk(placed.arm, served.paths[placed.name], files_in(folder), {"--arm": placed.name}) for placed in PAIR.arms
    ]
    async with console_of(stations, served, (80, 24)) as (app, pilot):
        await until(pilot, lambda: " left " in shown(app, "head") and "right HOLDING" in shown(app, "head"))
        assert "tab other arm" in shown(app, "hints")
        for arm in PAIR.names:
            pair.start_move(arm, *FREE, speed=0.1)
        await until(pilot, lambda: "right MOVING" in shown(app, "head"))
        await press(pilot, "tab")
        await until(pilot, lambda: " right " in shown(app, "head") and "left MOVING" in shown(app, "head"))
        await press(pilot, "space")
        await until(pilot, lambda: pair.mode("left") is pair.mode("right") is Mode.HOLDING)
        await press(pilot, "colon", "tab")
        assert app.desk.link.path.name == "right.sock"  # a line is being typed


def test_each_arm_has_its_screen_and_space_stops_all(tmp_path: Path) -> None:
    with holding_pair(scenario(APART, base="demo")) as pair:
        asyncio.run(operated(pair, tmp_path))


def test_each_arm_has_its_own_files_and_a_socket_is_of_one_arm() -> None:
    args = argparse.Namespace(
        cell="pair", socket=None, places="at/places.toml", teach="taught.csv", keep=None, sessions="sessions"
    )
    left, right = _of_cell(args)
    assert (left.files.places, right.files.taught) == (Path("at/places-left.toml"), Path("taught-right.csv"))
    assert right.shared["--socket"].endswith("right.sock")
    with pytest.raises(ArmError, match="--socket: not together with --cell"):
        _of_cell(argparse.Namespace(cell="pair", socket="x"))
