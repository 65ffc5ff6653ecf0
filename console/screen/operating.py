"""The console's main screen: the state of the arm, and the keys that move it."""

import asyncio
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from textual import events, work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Container, Vertical
from textual.screen import ModalScreen, Screen
from textual.widgets import Input, OptionList, Static

from console.places import PlacesError, read_places
from console.screen.dashboard import CommandBox, Dashboard, HeldButton, JogPad
from console.screen.drawing import EventLog, Panel, clock, row
from console.screen.jogging import RENEW_S, neighbour
from console.screen.operator import Message, RuntimeLink
from console.user_config import remember_degrees


# Paths of the console's files.
@dataclass(frozen=True, slots=True)
class Files:
    """Named places, taught way-points, the record of executed lines, the folder of sessions."""

    places: Path
    taught: Path
    lines: Path | None = None
    sessions: Path = Path("sessions")


OVERRIDES = (0.01, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
GUIDING = {
    "drives off: somebody HOLDS the arm": "guide",
    "gravity compensation: the drives hold the arm's weight": "guide --weightless",
}
OFF = "Stop, hold, drives off? The arm sinks on shorted windings;\non servos, ODrives and CiA 402 drives it drops: HOLD it."
FOUND_OFF = "The boards hold the arm as they were found.\nThey let go, and it drops: does somebody HOLD it?"
HINTS = "space STOP  1-9 xyz select  ←→ jog  t step  -+ speed  n on  h home  ? all keys"

HINTS_OF_SEVERAL = "space STOP all  tab other arm  1-9 xyz select  ←→ jog  n on  h home  ? keys"


class OperatingScreen(Screen[None]):
    """Panels, jog pad, command box."""

    AUTO_FOCUS = ""
    BINDINGS: ClassVar[list[BindingType]] = [
        *(Binding(str(n), f"select('J{n}')", show=False) for n in range(1, 10)),
        *(Binding(axis, f"select('{axis.upper()}')", show=False) for axis in "xyz"),
        *(Binding(axis, f"select('R{axis}')", show=False) for axis in "XYZ"),
        Binding("e", "toggle_frame", show=False),
        Binding("left", "jog(-1)", show=False),
        Binding("right", "jog(1)", show=False),
        Binding("t", "toggle_step", show=False),
        Binding("comma", "step_size(-1)", show=False),
        Binding("full_stop", "step_size(1)", show=False),
        Binding("minus", "jog_speed(-1)", show=False),
        Binding("plus,equals_sign", "jog_speed(1)", show=False),
        Binding("less_than_sign", "override(-1)", show=False),
        Binding("greater_than_sign", "override(1)", show=False),
        Binding("n", "line('enable')", show=False),
        Binding("o", "off", show=False),
        Binding("h", "home", show=False),
        Binding("g", "go", show=False),
        Binding("f", "run_file", show=False),
        Binding("p", "pause", show=False),
        Binding("u", "guide", show=False),
        Binding("r", "record", show=False),
        Binding("k", "keep", show=False),
        Binding("a", "line('acknowledge')", show=False),
        Binding("c", "calibrate", show=False),
        Binding("v", "toggle_plots", show=False),
        Binding("d", "toggle_degrees", show=False),
        Binding("pageup", "scroll_events(-1)", show=False),
        Binding("pagedown", "scroll_events(1)", show=False),
        Binding("tab", "next_arm", show=False),
        Binding("question_mark", "help", show=False),
    ]

    def __init__(self, dashboard: Dashboard, files: Files, open_session: Callable[[str], None], has_others: bool) -> None:
        """`open_session` gets the options of a calibration session; `has_others`: arms on screens of their own."""
        super().__init__()
        self._dashboard, self._operator, self._jogger = dashboard, dashboard.operator, dashboard.jogger
        self._link: RuntimeLink = self._operator.link
        self._files, self._open_session, self._has_others = files, open_session, has_others
        self._panels: dict[str, Panel] = {}  # by name: queries would cost more than drawing

    def compose(self) -> ComposeResult:
        """Panels from top to bottom; style.tcss arranges them."""
        yield Panel("head")
        with Container(id="upper"):
            yield Panel("joints", "Joints")
            yield Panel("status", "Status")
        with Container(id="lower"):
            yield from self._dashboard.panels()
            yield EventLog("events", "Events")
        with Container(id="jogging"):
            yield JogPad(self._jogger.targets)
        yield CommandBox()
        hints = Panel("hints")
        hints.show([row((HINTS_OF_SEVERAL if self._has_others else HINTS, "muted"))])
        yield hints

    def on_mount(self) -> None:
        """Focus the jog keys, not the command box."""
        self.query_one("#jogging").border_title = "Jog"
        self._panels = {str(panel.id): panel for panel in self.query(Panel)}
        self.set_focus(None)
        self.set_interval(RENEW_S, self._renew_held)

    def on_resize(self) -> None:
        """Redraw all panels for their new size."""
        self._dashboard.hurry()

    # ---- display

    def show(self, status: Message | None) -> None:
        """Show a new status, or None if the link is lost."""
        for text, is_error in self._dashboard.events(status):
            self.say(text, is_error)
        for name, rows in self._dashboard.changed(status, self._room, time.monotonic()):
            panel = self._panels.get(name)
            if panel is not None and panel.is_attached:  # no panel while the console closes
                panel.show(rows)

    def say(self, text: str, is_error: bool = False) -> None:
        """A line in the log."""
        for log in self.query("#events").results(EventLog):
            log.add(text, "error" if is_error else "plain", clock())

    def _room(self, name: str) -> tuple[int, int]:
        """Columns and rows inside a panel; zero if it is hidden."""
        panel = self._panels.get(name)
        return (panel.size.width, panel.size.height) if panel is not None and panel.display else (0, 0)

    # ---- jogging

    def action_select(self, name: str) -> None:
        """Select what the arrow keys jog."""
        self._jogger.select(name)
        self._dashboard.hurry()

    async def action_jog(self, sign: int) -> None:
        """A press or repeat of an arrow key."""
        await self._jogger.press(sign)

    async def on_held_button_held(self, event: HeldButton.Held) -> None:
        """A jog button went down or up."""
        if event.is_down:
            await self._jogger.hold(event.target, event.sign)
        else:
            await self.let_go()

    def on_mouse_move(self, _: events.MouseMove) -> None:
        """Note that the terminal is alive."""
        self._jogger.see()

    async def _renew_held(self) -> None:
        if not await self._jogger.renew():
            await self.let_go()

    async def let_go(self) -> None:
        """Release everything: mouse up, focus lost."""
        for button in self.query(HeldButton):
            button.let_go()
        await self._jogger.let_go()

    def action_toggle_step(self) -> None:
        """Toggle step or hold."""
        self._jogger.is_stepping = not self._jogger.is_stepping
        self._dashboard.hurry()

    def action_toggle_frame(self) -> None:
        """Toggle the axes of the tip and of the base."""
        self._jogger.toggle_frame()
        self._dashboard.hurry()

    def action_step_size(self, by: int) -> None:
        """Make steps smaller or larger."""
        self._jogger.change_step(by)

    def action_jog_speed(self, by: int) -> None:
        """Jog slower or faster."""
        self._jogger.change_speed(by)

    async def action_override(self, by: int) -> None:
        """Change the speed override, also for the active motion."""
        override = neighbour(OVERRIDES, self._dashboard.override, by)
        if await self._operator.line(f"override {override:g}"):
            self._dashboard.override = override  # later presses start from here, even before the next status

    # ---- panels

    def action_toggle_plots(self) -> None:
        """Show plots instead of the arm, if the terminal has room for only one."""
        self.toggle_class("-plots")

    def action_toggle_degrees(self) -> None:
        """Show joint angles in degrees or radians, now and from now on."""
        self._dashboard.in_degrees = not self._dashboard.in_degrees
        remember_degrees(self._dashboard.in_degrees)

    def action_scroll_events(self, pages: int) -> None:
        """Scroll the log by a page."""
        log = self.query_one("#events", EventLog)
        log.scroll_relative(y=pages * max(log.size.height - 1, 1), animate=False)

    # ---- lines

    async def action_line(self, text: str) -> None:
        """Run a line as if it were typed."""
        await self._operator.line(text)

    @work
    async def action_home(self) -> None:
        """Home, after confirmation."""
        question = "Home: every joint moves to its switch. Is the way clear?"
        if await self.app.push_screen_wait(Confirm(question)):
            await self._operator.line("home")

    async def action_pause(self) -> None:
        """Pause or resume."""
        status = self._link.status
        is_paused = status is not None and status["mode"] == "PAUSED"
        await self._operator.line("resume" if is_paused else "pause")

    async def action_record(self) -> None:
        """Record a way-point."""
        await self._operator.line(f"teach {self._files.taught}")

    @work
    async def action_off(self) -> None:
        """Turn the drives off, after confirmation."""
        status = self._link.status
        is_found = status is not None and (status["mode"] == "HELD" or status["drives"] == "AS_FOUND")
        question = FOUND_OFF if is_found else OFF
        if await self.app.push_screen_wait(Confirm(question)):
            await self._operator.line("off --yes" if is_found else "off")

    @work
    async def action_guide(self) -> None:
        """Start hand guiding: drives off, or with gravity compensation."""
        how = await self.app.push_screen_wait(Choose("Guide by hand", list(GUIDING)))
        if how is not None:
            await self._operator.line(GUIDING[how])

    @work
    async def action_go(self) -> None:
        """Move to a named place."""
        try:
            names = list(read_places(self._files.places))
        except PlacesError as error:
            self.say(str(error), True)
            return
        name = await self.app.push_screen_wait(Choose("Go to", names))
        if name is not None:
            await self._operator.line(f"go {name} --places {self._files.places}")

    @work
    async def action_keep(self) -> None:
        """Save this place by name."""
        question = "A name for this pose (letters, digits, - and _)"
        name = await self.app.push_screen_wait(AskText(question))
        if name is not None:
            await self._operator.line(f"mark '{name}' --places {self._files.places}")

    @work
    async def action_run_file(self) -> None:
        """Run a way-point file."""
        file = await self.app.push_screen_wait(AskText("A way-point file to run", str(self._files.taught)))
        if file is None:
            return
        if not Path(file).is_file():
            self.say(f"{file}: no such file", True)
            return
        await self._operator.line(f"run '{file}'")

    @work
    async def action_calibrate(self) -> None:
        """Open the calibration session; an existing folder is resumed."""
        folder = self._files.sessions / time.strftime("%Y-%m-%d")
        plan = "--camera --free 24" if self._dashboard.arm.table is None else "--setups normal,roll,pitch"
        options = f"--out {folder}" if folder.exists() else f"--out {folder} {plan}"
        question = "Options of `armwright session`; --out alone resumes one"
        line = await self.app.push_screen_wait(AskText(question, options))
        if line is not None:
            self._open_session(line)

    def action_command(self) -> None:
        """Focus the command box at once: what is typed next must not act as keys."""
        self.set_focus(self.query_one(CommandBox))

    async def action_next_arm(self) -> None:
        """Show the next arm; while a line is typed, the key does nothing."""
        if self._has_others and not isinstance(self.focused, Input):
            await self.run_action("app.next_arm")

    def action_help(self) -> None:
        """Show the keys."""
        self.app.push_screen(HelpDialog())

    async def on_input_submitted(self, event: Input.Submitted) -> None:
        """A line of the command box."""
        event.stop()
        if event.value:
            await self._operator.line(event.value)
        else:
            self.set_focus(None)
        await asyncio.sleep(0)


# No line is wider than 66, and there are 17: a terminal of 80 columns and 24 lines shows it whole.
HELP = """\
[b]space[/]     STOPS the arm, everywhere, and whatever line runs
[b]1[/]-[b]9[/]       jog joint 1 ...          [b]x y z[/]   jog the tip on an axis
[b]X Y Z[/]     turn it about an axis    [b]e[/]       axes of base or tip
[b]← →[/]       jog: hold the key; it moves while the key repeats
[b]t[/]         step or hold             [b], .[/]     step smaller, larger
[b]- +[/]       jog slower, faster       [b]< >[/]     speed override
[b]n[/]         drives on, and hold      [b]o[/]       stop, lower, drives off
[b]h[/]         home                     [b]g[/]       go to a named place
[b]f[/]         run a way-point file     [b]p[/]       pause, continue
[b]u[/]         guide by hand            [b]r[/]       record a way-point
[b]k[/]         save this place by name  [b]a[/]       acknowledge faults
[b]c[/]         calibration session      [b]:[/]       command box
[b]v[/]         plots or the arm         [b]d[/]       degrees or radians
[b]tab[/]       the next arm of a cell   [b]pgup[/] [b]pgdn[/]   scroll the events
[b]ctrl+q[/], [b]ctrl+c[/]   leave: the motion is stopped, the arm is held

Escape closes this."""


class HelpDialog(ModalScreen[None]):
    """The keys."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,enter,question_mark", "dismiss", show=False)]

    def compose(self) -> ComposeResult:
        """Compose the text."""
        with Vertical(classes="dialog"):
            yield Static(HELP)


class Confirm(ModalScreen[bool]):
    """Yes (Enter or y) or no (anything else)."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("enter,y", "answer(True)", show=False),
        Binding("escape,n", "answer(False)", show=False),
    ]

    def __init__(self, question: str) -> None:
        super().__init__()
        self._question = question

    def compose(self) -> ComposeResult:
        """The question and the keys."""
        with Vertical(classes="dialog"):
            yield Static(self._question)
            yield Static("\n[b]Enter[/] yes    [b]Escape[/] no    [b]space[/] stop")

    def action_answer(self, is_yes: bool) -> None:
        """Close with the answer."""
        self.dismiss(is_yes)


class AskText(ModalScreen[str | None]):
    """Ask for a line of text; Escape cancels."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape", "dismiss(None)", show=False)]

    def __init__(self, question: str, value: str = "") -> None:
        super().__init__()
        self._question, self._value = question, value

    def compose(self) -> ComposeResult:
        """The question and a box."""
        with Vertical(classes="dialog"):
            yield Static(self._question)
            yield Input(self._value, compact=True)

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Close with the text."""
        event.stop()
        self.dismiss(event.value.strip() or None)


class Choose(ModalScreen[str | None]):
    """Choose one of some names; Escape cancels."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape", "dismiss(None)", show=False)]

    def __init__(self, question: str, names: Sequence[str]) -> None:
        super().__init__()
        self._question, self._names = question, list(names)

    def compose(self) -> ComposeResult:
        """The question and a list."""
        with Vertical(classes="dialog"):
            yield Static(self._question)
            yield OptionList(*self._names)

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        """Close with the name."""
        event.stop()
        self.dismiss(self._names[event.option_index])
