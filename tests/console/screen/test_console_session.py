"""The calibration session on the console's screen: board, records, interruptions, and what becomes of the result."""

from __future__ import annotations

import asyncio
import json
import re
from pathlib import Path
from typing import Any

import pytest
from textual.pilot import Pilot
from textual.widgets import RichLog, Static

from console.screen.app import ConsoleApp
from console.screen.session import SessionScreen, board_lines, recorded_line
from tests.cell import Cell, holding_cell
from tests.console.console_rig import console_on, press, said, until

LIMIT_s = 120.0  # each waits for processes that share the machine with other tests


def shown(app: ConsoleApp, panel: str) -> str:
    return "".join(str(one.render()) for one in app.screen.query(f"#{panel}").results(Static))


def records(app: ConsoleApp) -> str:
    return "\n".join(strip.text.rstrip() for strip in app.screen.query_one("#records", RichLog).lines)


async def asked(app: ConsoleApp, pilot: Pilot[Any], text: str) -> None:
    """Wait until the session asks, or says, `text`."""
    await until(pilot, lambda: text in shown(app, "question"), LIMIT_s)


async def begin_and_leave(app: ConsoleApp, pilot: Pilot[Any], out: Path) -> None:
    """One cavity recorded, done again, skipped; and the session left."""
    app.open_session(f"--mock --out {out} --setups normal,roll --points 1,5,9,13,17,21,25,33")
    await until(pilot, lambda: isinstance(app.screen, SessionScreen))
    await asked(app, pilot, "Enter when it is in place")
    assert shown(app, "board").count(".") == 7
    assert shown(app, "board").count("O") == 1
    await press(pilot, "enter")
    await asked(app, pilot, "hands off")
    await press(pilot, "enter")
    await asked(app, pilot, "[2/16]")
    assert re.search(r"normal 1 +\d+\.\d\d", records(app))
    assert shown(app, "board").count("#") == 1
    await press(pilot, *"redo", "enter")
    await asked(app, pilot, "[1/16]")
    assert shown(app, "board").count("#") == 0
    await press(pilot, *"skip", "enter")
    await until(pilot, lambda: "-" in shown(app, "board"), LIMIT_s)
    await press(pilot, "escape")
    await until(pilot, lambda: app.screen is app.operating, LIMIT_s)
    await until(pilot, lambda: "resumes it" in said(app), LIMIT_s)


async def resume_and_accept(app: ConsoleApp, pilot: Pilot[Any], out: Path) -> None:
    """The skipped cavity is remembered; the rest by itself, then calibrated and accepted."""
    app.open_session(f"--mock --out {out}")
    await until(pilot, lambda: "-" in shown(app, "board"), LIMIT_s)
    await press(pilot, *"auto", "enter")
    await asked(app, pilot, "ends the session")
    await press(pilot, "enter")
    await asked(app, pilot, "Enter calibrates")
    await press(pilot, "enter")
    await asked(app, pilot, "Accept")
    await press(pilot, *"perhaps", "enter", "y", "enter")
    await asked(app, pilot, "Accepted")


def test_a_session_on_the_screen_is_interrupted_resumed_calibrated_and_accepted(tmp_path: Path) -> None:
    out = tmp_path / "s"

    async def run(cell: Cell) -> None:
        async with console_on(cell, tmp_path, (80, 24)) as (app, pilot, _):
            await begin_and_leave(app, pilot, out)
            await resume_and_accept(app, pilot, out)

    with holding_cell() as cell:
        asyncio.run(run(cell))
    assert json.loads((out / "calibrated-1" / "decision.json").read_text())["accepted"] is True
    assert (out / "calibrated-1" / "arm.toml").exists()
    assert len((out / "points.csv").read_text().splitlines()) == 1 + 15


def test_options_without_a_folder_are_refused_in_words(tmp_path: Path) -> None:
    async def run(cell: Cell) -> None:
        async with console_on(cell, tmp_path) as (app, pilot, _):
            app.open_session("--mock")
            await until(pilot, lambda: "expected --out FOLDER" in said(app))
            app.open_session(f"--mock --out {tmp_path / 's'} --points 99")
            await until(pilot, lambda: "ended with status 2" in shown(app, "question"), LIMIT_s)
            assert "99" in records(app)

    with holding_cell() as cell:
        asyncio.run(run(cell))


def test_the_board_keeps_its_proportions_in_any_room() -> None:
    places = ((0.09, 0.0, "now"), (-0.09, 0.0, "done"), (0.0, 0.09, "left"), (0.0, -0.09, "bad"))
    circle = [{"name": "1", "x_m": x, "y_m": y, "mark": mark} for x, y, mark in places]
    for width, height in ((64, 30), (40, 17), (20, 50), (200, 12)):
        lines = board_lines(circle, width, height)
        assert len(lines) <= max(height, 6)
        plain = [re.sub(r"\[[^]]*\]", "", line) for line in lines]
        assert max(map(len, plain)) <= max(width, 9)
        assert plain[0].strip() == "."
        assert plain[-1].strip() == "x"
        assert len(plain) == pytest.approx(max(map(len, plain)) / 2, abs=1.1)
    assert board_lines([], 40, 20) == ["no cavities in this setup"]


def test_a_record_says_how_it_fits_and_one_that_does_not_is_red() -> None:
    kept = {"kept": "normal 3", "text": "normal 3 recorded; look", "error_mm": 20.0}
    kept |= {"off_mm": 0.4, "surprise": 2.6, "is_suspect": False}
    assert recorded_line(kept).split() == ["normal", "3", "20.00", "0.40", "mm", "[none]", "2.6", "sd[/]"]
    assert "[yellow] 3.1 sd" in recorded_line({**kept, "surprise": 3.1})
    assert recorded_line({**kept, "is_suspect": True}) == "[b red]normal 3 recorded; look[/]"
    assert recorded_line({**kept, "surprise": None, "off_mm": None}).split() == ["normal", "3", "20.00"]
    assert recorded_line({**kept, "surprise": None, "off_mm": None, "error_mm": None}).split() == [
        "normal",
        "3",
        "-",
    ]
