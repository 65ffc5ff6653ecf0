"""The calibration session on the console's screen: board, records, interruptions, and what becomes of the result."""

from __future__ import annotations

import asyncio
import json
import re
from pathlib import Path
from typing import Any

import pytest
from textual.pilot import Pilot

from console.screen.app import ConsoleApp
from console.screen.drawing import EventLog, Panel, text_of
from console.screen.session import HEADING, SessionScreen, board_rows, legend_rows, record_text
from tests.cell import Cell, holding_cell
from tests.console.screen.console_rig import console_on, press, said, until

LIMIT_s = 300.0  # each waits for processes that share the machine with other tests


def shown(app: ConsoleApp, panel: str) -> str:
    return "".join(one.text for one in app.screen.query(f"#{panel}").results(Panel))


def records(app: ConsoleApp) -> str:
    return app.screen.query_one("#records", EventLog).text


async def record_some_and_leave(app: ConsoleApp, pilot: Pilot[Any], out: Path) -> None:
    """Record, take back, skip, and escape."""
    app.open_session(f"--mock --out {out} --setups normal,roll --points 1,9,17,25,33")
    await until(pilot, lambda: isinstance(app.screen, SessionScreen))
    await until(pilot, lambda: "Enter when it is in place" in shown(app, "question"), LIMIT_s)
    assert shown(app, "board").count(".") == 4
    assert shown(app, "board").count("O") == 1
    await press(pilot, "enter")
    await until(pilot, lambda: "hands off" in shown(app, "question"), LIMIT_s)
    await press(pilot, "enter")
    await until(pilot, lambda: "[2/10]" in shown(app, "question"), LIMIT_s)
    assert re.search(r"normal 1 +\d+\.\d\d", records(app))
    assert shown(app, "board").count("#") == 1
    await press(pilot, *"redo", "enter")
    await until(pilot, lambda: "[1/10]" in shown(app, "question"), LIMIT_s)
    assert shown(app, "board").count("#") == 0
    await press(pilot, *"skip", "enter")
    await until(pilot, lambda: "-" in shown(app, "board"), LIMIT_s)
    await press(pilot, "escape")
    await until(pilot, lambda: app.screen is app.operating, LIMIT_s)
    await until(pilot, lambda: "resumes it" in said(app), LIMIT_s)


async def resume_and_accept(app: ConsoleApp, pilot: Pilot[Any], out: Path) -> None:
    """Go on to the end, calibrate, and accept."""
    app.open_session(f"--mock --out {out}")
    await until(pilot, lambda: "-" in shown(app, "board"), LIMIT_s)
    await press(pilot, *"auto", "enter")
    await until(pilot, lambda: "ends the session" in shown(app, "question"), LIMIT_s)
    await press(pilot, "enter")
    await until(pilot, lambda: "Enter calibrates" in shown(app, "question"), LIMIT_s)
    await press(pilot, "enter")
    await until(pilot, lambda: "Accept" in shown(app, "question"), LIMIT_s)
    await press(pilot, *"perhaps", "enter", "y", "enter")
    await until(pilot, lambda: "Accepted" in shown(app, "question"), LIMIT_s)


@pytest.mark.nightly
def test_a_session_on_the_screen_is_interrupted_resumed_calibrated_and_accepted(tmp_path: Path) -> None:
    out = tmp_path / "s"

    async def run(cell: Cell) -> None:
        async with console_on(cell, tmp_path, (80, 24)) as (app, pilot, _):
            await record_some_and_leave(app, pilot, out)
            await resume_and_accept(app, pilot, out)

    with holding_cell() as cell:
        asyncio.run(run(cell))
    assert json.loads((out / "calibrated-1" / "decision.json").read_text())["accepted"] is True
    assert (out / "calibrated-1" / "arm.toml").exists()
    assert len((out / "points.csv").read_text().splitlines()) == 1 + 9


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
        plain = [line.rstrip() for line in text_of(board_rows(circle, width, height)).splitlines()]
        assert len(plain) <= max(height, 6)
        assert max(map(len, plain)) <= max(width, 9)
        assert plain[0].strip() == "."
        assert plain[-1].strip() == "x"
        assert len(plain) == pytest.approx(max(map(len, plain)) / 2, abs=1.1)
    assert text_of(board_rows([], 40, 20)) == "no cavities in this setup"


def test_the_legend_is_whole_on_any_width() -> None:
    for width in (32, 40, 64, 120):
        rows = legend_rows(width)
        assert " ".join(text_of(rows).split()) == "# done + some repeats O now . left - skipped x bad"
        assert max(len(line.rstrip()) for line in text_of(rows).splitlines()) <= width


def test_a_record_tells_how_it_fits_and_one_that_does_not_is_an_error() -> None:
    record = {"recorded": "normal 3", "text": "normal 3 recorded; look", "error_mm": 20.0}
    record |= {"deviation_mm": 0.4, "deviation_sd": 2.6, "is_suspect": False}
    text, look = record_text(record)
    assert (text.split(), look) == (["normal", "3", "20.00", "0.40", "2.6"], "plain")
    text, look = record_text({**record, "deviation_sd": 3.1})
    assert (text.split()[-2:], look) == (["3.1", "~"], "warning")
    assert max(len(HEADING), len(text)) <= 42  # columns beside the board at 80 by 24
    assert record_text({**record, "is_suspect": True}) == ("normal 3 recorded; look", "error")
    assert record_text({**record, "deviation_sd": None, "deviation_mm": None})[0].split() == ["normal", "3", "20.00"]
    unknown = {**record, "deviation_sd": None, "deviation_mm": None, "error_mm": None}
    assert record_text(unknown)[0].split() == ["normal", "3", "-"]
