"""The console as a Textual application: the link, the operator, and the space bar as the stop."""

import asyncio
import os
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

from textual import events
from textual.app import App
from textual.binding import Binding, BindingType
from textual.filter import LineFilter
from textual.widgets import Input

from console.lines.grammar import Grammar
from console.screen.dashboard import Dashboard
from console.screen.drawing.plain import AsciiFilter, is_plain
from console.screen.drawing.theme import THEME
from console.screen.files import Files
from console.screen.jogging import Jogger
from console.screen.link import Message, RuntimeLink
from console.screen.operating import OperatingScreen
from console.screen.operator import MOVING, Operator
from console.screen.session import SessionScreen
from console.specs.table import COMMANDS
from control.model.arm import Arm

__all__ = ["ConsoleApp", "Files"]
COMMAND_KEYS = ("colon", "slash")


class ConsoleApp(App[None]):
    """`armwright console`. On exit its connection closes, which stops its motion; the arm holds."""

    CSS_PATH = "style.tcss"
    HORIZONTAL_BREAKPOINTS = [(0, "-narrow"), (110, "-wide"), (160, "-huge")]  # noqa: RUF012 - as Textual declares it
    VERTICAL_BREAKPOINTS = [(0, "-short"), (34, "-tall")]  # noqa: RUF012 - as Textual declares it
    ENABLE_COMMAND_PALETTE = False
    TITLE = "armwright"
    BINDINGS: ClassVar[list[BindingType]] = [Binding("ctrl+q,ctrl+c", "quit", show=False, priority=True)]

    def __init__(self, arm: Arm, socket: Path, files: Files, shared: Mapping[str, str]) -> None:
        """`shared`: options for every subcommand, such as --arm and --socket."""
        super().__init__(ansi_color=False)
        self.register_theme(THEME)
        self.theme = THEME.name
        self._arm_name = shared.get("--arm", arm.name)
        self._shared = dict(shared)
        self._filter = AsciiFilter(is_plain(os.environ))
        self.link = RuntimeLink(socket, self._on_status)
        grammar = Grammar(COMMANDS, {flag.lstrip("-"): value for flag, value in shared.items()})
        words = [word for pair in shared.items() for word in pair]
        self.operator = Operator(self.link, grammar, words, self.say, files.lines)
        self.jogger = Jogger(arm, self.operator, self.say)
        dashboard = Dashboard(arm, self.operator, self.jogger)
        self.operating = OperatingScreen(dashboard, self.operator, self.jogger, files, self.open_session)

    def get_line_filters(self) -> Sequence[LineFilter]:
        """Textual's filters, and ASCII if the terminal shows nothing else."""
        return [*super().get_line_filters(), *([self._filter] if self._filter.enabled else [])]

    def on_mount(self) -> None:
        """Open the main screen, and the link."""
        self.push_screen(self.operating)
        self.run_worker(self.link.run(), group="link")

    async def on_event(self, event: events.Event) -> None:
        """Space stops before any screen, dialog or box receives it; a box receives it if nothing moves.

        The colon is also handled here: what is typed after it must not act as keys that move the arm, however fast it
        comes.
        """
        if isinstance(event, events.Key) and not event.is_forwarded:
            is_typing = isinstance(self.focused, Input)
            if event.key == "space":
                self._stopping = asyncio.create_task(self.action_stop())  # later keys need not wait
                if not (is_typing and self._is_resting()):
                    return
            elif event.key in COMMAND_KEYS and not is_typing and self.screen is self.operating:
                self.operating.action_command()
                return
        await super().on_event(event)

    async def on_app_blur(self, _: events.AppBlur) -> None:
        """Release the jog: the terminal lost the focus, so a held key is held elsewhere."""
        await self.operating.let_go()

    async def action_stop(self) -> None:
        """Controlled stop, and end the running line."""
        await self.operator.stop()

    async def action_quit(self) -> None:
        """Exit; the arm holds."""
        self.operator.end_line()
        if isinstance(self.screen, SessionScreen):
            self.screen.end()
        self.exit()

    def say(self, text: str, is_error: bool = False) -> None:
        """Write a line to the log."""
        if self.operating.is_mounted:
            self.operating.say(text, is_error)

    def open_session(self, line: str) -> None:
        """Open the calibration session with these options of `armwright session`."""
        words = shlex.split(line)
        if "--out" not in words[:-1]:
            self.say("session: expected --out FOLDER among its options", True)
            return
        known = [word for flag, value in self._shared.items() if flag not in words for word in (flag, value)]
        folder = Path(words[words.index("--out") + 1])
        self.push_screen(SessionScreen(shlex.join([*words, *known]), folder, self._arm_name, self.say))

    def _is_resting(self) -> bool:
        return self.link.status is not None and self.link.status["mode"] not in MOVING

    async def _on_status(self, status: Message | None) -> None:
        if status is None:
            await self.operating.let_go()
        elif self.jogger.has_jogged and status["mode"] not in ("JOGGING", "STOPPING"):
            self.jogger.has_jogged = False
            if status["is_homed"] and status["mode"] == "HOLDING":
                angles = " ".join(f"{q:.5f}" for q in status["joint_rad"])
                self.operator.record(f"move --joints {angles} --speed 0.2")
        if self.operating.is_mounted:
            self.operating.show(status)
