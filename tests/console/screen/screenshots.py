"""`make screenshots`: the pictures of docs/console.md, of the real console on the mock arm, without a terminal.

`python -m tests.console.screen.screenshots FOLDER [NAME ...]` writes console_main.png, console_wide.png and console_session.png.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import sys
import tempfile
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import resvg_py
from textual.pilot import Pilot

from console.screen.app import ConsoleApp
from console.screen.drawing import Panel
from tests.cell import Cell, handled, holding_cell, scenario
from tests.console.screen.console_rig import Served, console_on, press, said, shown, until

FONT = "DejaVu Sans Mono"  # it has braille
GOALS = ((0.6, -0.4, 0.6), (-0.3, -0.9, 0.3), (0.5, -0.6, 0.9))
SESSION = "--mock --setups normal --out"
RECORDS = 12
LIMIT_s = 300.0
Play = Callable[[ConsoleApp, Pilot[Any], Served], Awaitable[None]]


def main(folder: Path, *names: str) -> None:
    """Write the pictures, or those of these names."""
    folder = folder.resolve()
    for name, size, play in (
        ("console_main", (120, 40), _moves_and_pauses),
        ("console_wide", (200, 50), _moves_and_pauses),
        ("console_session", (120, 40), _session),
    ):
        if names and name not in names:
            continue
        svg = asyncio.run(_played(play, size))
        png = resvg_py.svg_to_bytes(svg_string=svg.replace("Fira Code", FONT), font_family=FONT)
        (folder / f"{name}.png").write_bytes(bytes(png))
        print(f"{folder / name}.png")


async def _played(play: Play, size: tuple[int, int]) -> str:
    with (
        tempfile.TemporaryDirectory() as name,
        contextlib.chdir(name),  # a picture shows no folder of the machine that made it
        holding_cell(scenario(base="demo")) as cell,
    ):
        return await _drawn(cell, Path(name), play, size)


async def _drawn(cell: Cell, folder: Path, play: Play, size: tuple[int, int]) -> str:
    async with console_on(cell, folder, size) as (app, pilot, served):
        await play(app, pilot, served)
        return app.export_screenshot()


async def _moves_and_pauses(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
    """Three motions, the last one paused on its way."""
    for goal in GOALS:
        await until(pilot, lambda: _mode(app) == "HOLDING", LIMIT_s)
        answer = handled(served.cell, {"do": "move_joints", "q_rad": list(goal), "speed": 0.25, "detached": True}, 99)
        if not answer["ok"]:
            raise RuntimeError(answer["error"])
        await until(pilot, lambda: _mode(app) == "MOVING", LIMIT_s)
    await until(pilot, lambda: _progress(app) > 0.6, LIMIT_s)
    await press(pilot, "2", "p")
    await until(pilot, lambda: "PAUSED" in shown(app, "head") and "PAUSED" in said(app), LIMIT_s)
    await asyncio.sleep(1.0)  # each panel has been drawn since


def _mode(app: ConsoleApp) -> str:
    return str(app.link.status["mode"]) if app.link.status is not None else ""


def _progress(app: ConsoleApp) -> float:
    return float(app.link.status["progress"]) if app.link.status is not None else math.nan


async def _session(app: ConsoleApp, pilot: Pilot[Any], served: Served) -> None:
    """A session on a mock of its own, half of the first setup recorded."""
    app.open_session(f"{SESSION} monday")
    answered = ""
    while f"[{RECORDS + 1}/" not in answered:
        await until(pilot, lambda: _question(app) not in ("", answered), LIMIT_s)  # noqa: B023 - waited for at once
        answered = _question(app)
        if f"[{RECORDS + 1}/" not in answered:
            await press(pilot, "enter")


def _question(app: ConsoleApp) -> str:
    return "".join(panel.text for panel in app.screen.query("#question").results(Panel))


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
