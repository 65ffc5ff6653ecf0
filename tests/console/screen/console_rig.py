"""The real console, headless, over a real socket to a runtime on a stepped mock arm; all on one event loop.

Time of the arm runs with the host's, in small steps between what the console does, so that a dead man's switch means what it
means; `pump` may run it faster.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from textual import events
from textual.pilot import Pilot
from textual.widget import Widget

from console.screen.app import ArmAtDesk, ConsoleApp
from console.screen.drawing import EventLog, Panel
from console.screen.operating import Files
from control.model.arm import Arm
from control.server.server import Server
from tests.cell import PERIOD_S, RIGHT, Cell
from tests.pair import Pair

STEP_S = 0.01
REPEAT_S = 0.03  # of a held key
LIMIT_S = 300.0  # a busy machine is slow, a broken console never gets there
PATIENT_CLIENT = f"""
import runpy, sys
from control.server.channel import SocketChannel
from firmware_iface.interrupts import end_at_once
end_at_once()
SocketChannel.__init__.__defaults__ = ({LIMIT_S}, *SocketChannel.__init__.__defaults__[1:])
del sys.argv[0]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""
CHARACTERS = {"space": " ", "full_stop": ".", "underscore": "_", "minus": "-", "greater_than_sign": ">", "colon": ":"}
NAMES = {char: name for name, char in CHARACTERS.items()}


class Served:
    """A cell whose runtime answers on a socket while the event loop runs."""

    def __init__(self, cell: Cell | Pair, folder: Path, arms: Sequence[str] = ()) -> None:
        """`arms`: names, each of which gets a socket of its own."""
        self.cell = cell
        self.path = folder / "runtime.sock"
        self.paths = {arm: folder / f"{arm}.sock" for arm in arms}
        self.server: Server | None = self._listen()
        self.is_frozen = False

    def _listen(self) -> Server:
        requests = self.cell.assembly.requests
        return Server(self.paths or self.path, requests.handle, requests.on_gone)

    async def run(self) -> None:
        """Until cancelled: cycles as the host's time passes, a request after each."""
        loop = asyncio.get_running_loop()
        last_s = loop.time()
        while True:
            await asyncio.sleep(STEP_S / 2)
            now_s = loop.time()
            cycles = min(int((now_s - last_s) / PERIOD_S), 25)  # a busy host slows the arm down, no more
            last_s = now_s
            if self.is_frozen:
                continue
            for _ in range(cycles):
                self.cell.run(PERIOD_S)
                if self.server is not None:
                    self.server.poll()

    def vanish(self) -> None:
        """The runtime's process is gone, with its socket."""
        if self.server is not None:
            self.server.close()
            self.server = None

    def return_(self) -> None:
        """It is back."""
        self.server = self._listen()


@contextlib.asynccontextmanager
async def console_on(
    cell: Cell, folder: Path, size: tuple[int, int] = (80, 24), arm: Arm = RIGHT
) -> AsyncIterator[tuple[ConsoleApp, Pilot[Any], Served]]:
    """The console, connected."""
    served = Served(cell, folder)
    shared = {"--arm": "right", "--socket": str(served.path)}
    async with console_of([ArmAtDesk(arm, served.path, files_in(folder), shared)], served, size) as (app, pilot):
        yield app, pilot, served


def files_in(folder: Path) -> Files:
    """The console's files."""
    return Files(folder / "places.toml", folder / "taught.csv", folder / "kept.txt", folder / "sessions")


@contextlib.asynccontextmanager
async def console_of(
    stations: Sequence[ArmAtDesk], served: Served, size: tuple[int, int]
) -> AsyncIterator[tuple[ConsoleApp, Pilot[Any]]]:
    """The console of some arms, connected. They share its event loop: neither it nor its processes lose them by waiting."""
    app = ConsoleApp(stations)
    for desk in app.desks:
        desk.link.answer_s = LIMIT_S
    patch = pytest.MonkeyPatch()
    patch.setattr("console.screen.operator.command", lambda *words: [sys.executable, "-c", PATIENT_CLIENT, *words])
    pump = asyncio.create_task(served.run())
    try:
        async with app.run_test(size=size) as pilot:
            await until(pilot, lambda: "homed" in shown(app, "head"))
            yield app, pilot
            for desk in app.desks:
                desk.link.path = Path("/nowhere")
    finally:
        patch.undo()
        pump.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await pump
        served.vanish()


async def until(pilot: Pilot[Any], is_so: Callable[[], bool], limit_s: float = LIMIT_S) -> None:
    """Let the event loop run until something is so."""
    loop = asyncio.get_running_loop()
    end_s = loop.time() + limit_s
    while not is_so():
        await asyncio.sleep(0.01)
        if loop.time() > end_s:
            app: Any = pilot.app
            mode = app.link.status and app.link.status["mode"]
            raise AssertionError(f"not so within {limit_s} s: {mode}, {app.screen}, {app.focused}: {said(app)}")


async def press(pilot: Pilot[Any], *keys: str) -> None:
    """Keys as a terminal sends them. Pilot.press waits for an idle process, which one with an arm in it never is."""
    for key in keys:
        name = NAMES.get(key, key)
        char = CHARACTERS.get(name, key if len(key) == 1 else None)
        pilot.app.post_message(events.Key(name, char))
        await asyncio.sleep(0.005)


async def hold_key(pilot: Pilot[Any], key: str, is_so: Callable[[], bool], limit_s: float = LIMIT_S) -> None:
    """As a terminal does it when a key has been held for a while: repeats, until something is so."""
    end_s = asyncio.get_running_loop().time() + limit_s
    while not is_so():
        await press(pilot, key)
        await asyncio.sleep(REPEAT_S)
        assert asyncio.get_running_loop().time() < end_s, f"{key} had no effect: {said(pilot.app)}"


def mouse(pilot: Pilot[Any], widget: Widget, kind: type[events.MouseEvent]) -> None:
    """A mouse event in the middle of a widget."""
    x, y = widget.region.x + widget.region.width // 2, widget.region.y
    pilot.app.post_message(kind(widget, x, y, 0, 0, 1, False, False, False, x, y))


def said(app: Any) -> str:
    """What the log of events holds."""
    return "\n".join(log.text for log in app.operating.query("#events").results(EventLog))


def shown(app: Any, panel: str) -> str:
    """What a panel shows, without colours."""
    return app.operating.query_one(f"#{panel}", Panel).text
