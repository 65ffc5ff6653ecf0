"""The console as a Textual application: a screen an arm, and the space bar as the stop of all."""

import asyncio
import os
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from textual import events
from textual.app import App
from textual.binding import Binding, BindingType
from textual.filter import LineFilter
from textual.widgets import Input

from console.lines import Grammar
from console.screen.dashboard import Dashboard
from console.screen.drawing import THEME, AsciiFilter, is_plain
from console.screen.jogging import Jogger
from console.screen.operating import Files, OperatingScreen
from console.screen.operator import MOVING, Message, RuntimeLink, ScreenOperator
from console.screen.session import SessionScreen
from console.specs.table import COMMANDS
from control.model.arm import Arm


# One arm at the console: its link to the runtime, its operator, its jogs and its screen.
@dataclass(frozen=True, slots=True)
class ArmAtDesk:
    """An arm to operate; `shared`: options for every subcommand, such as --arm and --socket."""

    arm: Arm
    socket: Path
    files: Files
    shared: Mapping[str, str]


class Desk:
    """Reports of lines and statuses go to its own screen."""

    def __init__(self, station: ArmAtDesk, open_session: Callable[[str], None], others: int) -> None:
        """`open_session` gets the options of a calibration session; `others`: how many arms there are beside it."""
        arm, files, self.shared = station.arm, station.files, dict(station.shared)
        self.arm_name = self.shared.get("--arm", arm.name)
        self.link = RuntimeLink(station.socket, arm, self._on_status)
        grammar = Grammar(COMMANDS, {flag.lstrip("-"): value for flag, value in self.shared.items()})
        words = [word for pair in self.shared.items() for word in pair]
        self.operator = ScreenOperator(self.link, grammar, words, self.say, files.lines)
        self.jogger = Jogger(arm, self.operator, self.say)
        dashboard = Dashboard(arm, self.operator, self.jogger)
        self.operating = OperatingScreen(dashboard, files, open_session, has_others=others > 0)

    def say(self, text: str, is_error: bool = False) -> None:
        """Write a line to the log."""
        if self.operating.is_mounted:
            self.operating.say(text, is_error)

    @property
    def is_resting(self) -> bool:
        """Whether the arm does not move, as far as is known."""
        return self.link.status is not None and self.link.status["mode"] not in MOVING

    async def _on_status(self, status: Message | None) -> None:
        if status is None:
            await self.operating.let_go()
            self.jogger.run = None
        elif self.jogger.run is not None and self.jogger.run <= status["run"] and status["mode"] not in ("JOGGING", "STOPPING"):
            self.jogger.run = None
            if status["is_homed"] and status["mode"] == "HOLDING":
                angles = " ".join(f"{q:.5f}" for q in status["joint_rad"])
                self.operator.record(f"move --joints {angles} --speed 0.2")
        if self.operating.is_mounted:
            self.operating.show(status)


COMMAND_KEYS = ("colon", "slash")


class ConsoleApp(App[None]):
    """`armwright console`. On exit its connection closes, which stops its motion; the arm holds."""

    CSS_PATH = "style.tcss"
    HORIZONTAL_BREAKPOINTS = [(0, "-narrow"), (110, "-wide"), (160, "-huge")]  # noqa: RUF012 - as Textual declares it
    VERTICAL_BREAKPOINTS = [(0, "-short"), (34, "-tall")]  # noqa: RUF012 - as Textual declares it
    ENABLE_COMMAND_PALETTE = False
    TITLE = "armwright"
    BINDINGS: ClassVar[list[BindingType]] = [Binding("ctrl+q,ctrl+c", "quit", show=False, priority=True)]

    def __init__(self, stations: Sequence[ArmAtDesk]) -> None:
        """One screen an arm; the first is shown."""
        super().__init__(ansi_color=False)
        self.register_theme(THEME)
        self.theme = THEME.name
        self._filter = AsciiFilter(is_plain(os.environ))
        self.desks = [Desk(station, self.open_session, len(stations) - 1) for station in stations]
        self.desk = self.desks[0]

    @property
    def link(self) -> RuntimeLink:
        """To the runtime, of the arm that is shown."""
        return self.desk.link

    @property
    def operator(self) -> ScreenOperator:
        """Of the arm that is shown."""
        return self.desk.operator

    @property
    def jogger(self) -> Jogger:
        """Of the arm that is shown."""
        return self.desk.jogger

    @property
    def operating(self) -> OperatingScreen:
        """Of the arm that is shown."""
        return self.desk.operating

    def get_line_filters(self) -> Sequence[LineFilter]:
        """Textual's filters, and ASCII if the terminal shows nothing else."""
        return [*super().get_line_filters(), *([self._filter] if self._filter.enabled else [])]

    def on_mount(self) -> None:
        """Open the screens, and the links."""
        for desk in reversed(self.desks):
            self.install_screen(desk.operating, desk.link.path.name)
            self.push_screen(desk.operating)
            self.run_worker(desk.link.run(), group="link")

    async def action_next_arm(self) -> None:
        """Show the next arm; a jog of this one ends."""
        await self.operating.let_go()
        self.desk = self.desks[(self.desks.index(self.desk) + 1) % len(self.desks)]
        self.switch_screen(self.operating)

    async def on_event(self, event: events.Event) -> None:
        """Space stops before any screen, dialog or box receives it; a box receives it if nothing moves.

        The colon is also handled here: what is typed after it must not act as keys that move the arm, however fast it
        comes.
        """
        if isinstance(event, events.Key) and not event.is_forwarded:
            is_typing = isinstance(self.focused, Input)
            if event.key == "space":
                self._stopping = asyncio.create_task(self.action_stop())  # later keys need not wait
                if not (is_typing and all(desk.is_resting for desk in self.desks)):
                    return
            elif event.key in COMMAND_KEYS and not is_typing and self.screen is self.operating:
                self.operating.action_command()
                return
        await super().on_event(event)

    async def on_app_blur(self, _: events.AppBlur) -> None:
        """Release the jog: the terminal lost the focus, so a held key is held elsewhere."""
        await self.operating.let_go()

    async def action_stop(self) -> None:
        """Controlled stop of all arms, and end of all running lines."""
        await asyncio.gather(*(desk.operator.stop() for desk in self.desks))

    async def action_quit(self) -> None:
        """Exit; the arms hold."""
        for desk in self.desks:
            desk.operator.end_line()
        if isinstance(self.screen, SessionScreen):
            self.screen.end()
        self.exit()

    def say(self, text: str, is_error: bool = False) -> None:
        """Write a line to the log of the arm that is shown."""
        self.desk.say(text, is_error)

    def open_session(self, line: str) -> None:
        """Open the calibration session with these options of `armwright session`."""
        words = shlex.split(line)
        if "--out" not in words[:-1]:
            self.say("session: expected --out FOLDER among its options", True)
            return
        known = [word for flag, value in self.desk.shared.items() if flag not in words for word in (flag, value)]
        folder = Path(words[words.index("--out") + 1])
        self.push_screen(SessionScreen(shlex.join([*words, *known]), folder, self.desk.arm_name, self.say))
