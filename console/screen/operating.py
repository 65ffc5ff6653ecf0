"""The console's main screen: what the arm does, and the keys that move it."""

import asyncio
import time
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from textual import events, work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal
from textual.screen import Screen
from textual.widgets import Input, RichLog, Static

from console.places import PlacesError, read_places
from console.screen import texts
from console.screen.dialogs import AskText, Choose, Confirm, HelpDialog
from console.screen.held import HeldKey
from console.screen.link import Message
from console.screen.operator import Target
from console.screen.picture import Scene, Skeleton, side_view, top_view
from console.screen.widgets import CommandBox, HeldButton, JogPad

if TYPE_CHECKING:
    from console.screen.app import ConsoleApp

SPEEDS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # of a jog's limit
PACES = (0.01, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
STEPS_rad = (0.0005, 0.001, 0.005, 0.02, 0.1)
STEPS_m = (0.0001, 0.0005, 0.001, 0.005, 0.02)
GUIDING = {
    "drives off: somebody HOLDS the arm": "guide",
    "weightless: the drives carry the arm": "guide --weightless",
}
TEXT_S, PICTURE_S = 0.12, 0.25  # how often panels are drawn anew
RENEW_S = 0.05
UNSEEN_S = 2.0  # a button that is held with a mouse that says nothing for so long: the terminal may be gone
HINTS = "space STOP  1-9 xyz pick  ←→ jog  t step  -+ speed  n on  h home  p pause  ? more"


class OperatingScreen(Screen[None]):
    """Panels, jog pad, command box."""

    AUTO_FOCUS = ""
    BINDINGS: ClassVar[list[BindingType]] = [
        *(Binding(str(n), f"select('J{n}')", show=False) for n in range(1, 10)),
        *(Binding(axis, f"select('{axis.upper()}')", show=False) for axis in "xyz"),
        Binding("left", "jog(-1)", show=False),
        Binding("right", "jog(1)", show=False),
        Binding("t", "toggle_step", show=False),
        Binding("comma", "step_size(-1)", show=False),
        Binding("full_stop", "step_size(1)", show=False),
        Binding("minus", "jog_speed(-1)", show=False),
        Binding("plus,equals_sign", "jog_speed(1)", show=False),
        Binding("less_than_sign", "pace(-1)", show=False),
        Binding("greater_than_sign", "pace(1)", show=False),
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
        Binding("question_mark", "help", show=False),
    ]
    app: "ConsoleApp"

    def __init__(self, skeleton: Skeleton) -> None:
        super().__init__()
        self.selected = Target(1, None)
        self.speed, self.pace = 0.2, 1.0
        self.is_stepping = False
        self._step_at = 2
        self._skeleton = skeleton
        self._history = texts.History()
        self._key = HeldKey()
        self._text_s = self._picture_s = -1e9
        self._held: tuple[Target, int] | None = None
        self._seen_s = 0.0
        self._shown: dict[str, str] = {}

    def compose(self) -> ComposeResult:
        """Panels from top to bottom."""
        yield Static(id="head")
        yield Static(id="joints")
        with Horizontal(id="middle"):
            yield Static(id="side")
            yield Static(id="top")
            yield Static(id="charts")
        yield Static(id="news")
        yield RichLog(id="said", wrap=True, markup=True, max_lines=500)
        yield JogPad(self._targets())
        yield CommandBox()
        yield Static(HINTS, id="hints")

    def on_mount(self) -> None:
        """Keys are for jogging until the command box is asked for."""
        self.query_one("#said", RichLog).can_focus = False
        self.set_focus(None)
        self.set_interval(RENEW_S, self._renew_held)

    # ---- what is shown

    def show(self, status: Message | None) -> None:
        """A new status, or none: the link is lost."""
        now_s = time.monotonic()
        if status is not None:
            self._history.add(status)
        if now_s - self._text_s >= TEXT_S or status is None:
            self._text_s = now_s
            self._show_texts(status)
        if status is not None and now_s - self._picture_s >= PICTURE_S:
            self._picture_s = now_s
            self._show_pictures(status)

    def say(self, text: str, is_bad: bool = False) -> None:
        """A line in the log."""
        shown = texts.escaped(text)
        for log in self.query("#said").results(RichLog):  # none is there while the console closes
            log.write(f"[b yellow]{shown}[/]" if is_bad else shown)

    def _show_texts(self, status: Message | None) -> None:
        arm, name = self.app.arm, self.selected.name
        self._put("head", texts.headline(status, arm, self.app.link.why_lost))
        if status is not None:
            self.pace = status["override"]
            lines = [*texts.joint_lines(status, arm, name), texts.tip_line(status, name), self._jog_line()]
            self._put("joints", "\n".join(lines))
        self._put("news", "\n".join(texts.news_lines(status, self.app.link.why_lost)))

    def _jog_line(self) -> str:
        joint = self.selected.joint is not None
        size = f"{STEPS_rad[self._step_at]:g} rad" if joint else f"{1e3 * STEPS_m[self._step_at]:g} mm"
        how = f"[b]step[/] {size}" if self.is_stepping else "[b]hold[/] the key"
        word = self.app.operator.running.partition(" ")[0]
        running = f"   running: {texts.escaped(word)}" if word else ""
        return f"jog {self.selected.name}: {how}, {100 * self.speed:g} %   pace of motions {100 * self.pace:g} %{running}"

    def _show_pictures(self, status: Message) -> None:
        scene, reach_m = self._scene(status), self._skeleton.reach_m
        for name, title, view in (("side", "side x, z", side_view), ("top", "top x, y", top_view)):
            for panel in self.query(f"#{name}").results(Static):
                columns, rows = panel.size
                if columns > 4 and rows > 2:
                    self._put(name, "\n".join([f"[dim]{title}[/]", *view(scene, columns, rows - 1, reach_m)]))
        for charts in self.query("#charts").results(Static):
            if charts.display:
                self._put(
                    "charts", "\n".join(texts.chart_lines(self._history, self.app.arm, charts.size.width))
                )

    def _scene(self, status: Message) -> Scene:
        if not status["is_homed"]:
            return Scene([], [], self._skeleton.board)
        return Scene(self._skeleton.corners(status["joint_rad"]), [], self._skeleton.board)

    def _put(self, name: str, text: str) -> None:
        """Only what has changed is drawn: over a slow line, and for the processor's sake."""
        if self._shown.get(name) != text:
            self._shown[name] = text
            for panel in self.query(f"#{name}").results(Static):  # none is there while the console closes
                panel.update(text)

    def _targets(self) -> list[Target]:
        joints = [Target(j + 1, None) for j in range(self.app.arm.joint_count)]
        return [*joints, *(Target(None, axis) for axis in "xyz")]

    # ---- jogging

    def action_select(self, name: str) -> None:
        """What the arrow keys jog."""
        for target in self._targets():
            if target.name == name:
                self.selected = target
                self._key.forget()
                self._text_s = -1e9

    async def action_jog(self, sign: int) -> None:
        """The arrow key, once more."""
        press = self._key.press(f"{self.selected.name}{sign}", time.monotonic())
        if self.is_stepping:
            self._step(self.selected, sign)
        elif press.is_due:
            await self._jog(self.selected, sign)

    def _step(self, target: Target, sign: int) -> None:
        sizes = STEPS_rad if target.joint is not None else STEPS_m
        self.app.operator.step(target, sign * sizes[self._step_at], round(self._most(target) * self.speed, 6))

    async def _jog(self, target: Target, sign: int) -> None:
        speed = sign * self.speed * self._most(target)
        self.app.has_jogged = True
        await self.app.operator.jog(target, speed, self.app.arm.joint_count)

    def _most(self, target: Target) -> float:
        """Greatest speed of a jog, rad/s or m/s."""
        limits = self.app.jog_limits
        return (
            limits.joints.speed_rad_s[target.joint - 1] if target.joint is not None else limits.tip_speed_m_s
        )

    async def on_held_button_held(self, event: HeldButton.Held) -> None:
        """A jog button went down or up."""
        self.selected = event.target
        if not event.is_down:
            await self.let_go()
        elif self.is_stepping:
            self._step(event.target, event.sign)
        else:
            self._held, self._seen_s = (event.target, event.sign), time.monotonic()
            await self._jog(event.target, event.sign)

    def on_mouse_move(self, _: events.MouseMove) -> None:
        """The terminal is there."""
        self._seen_s = time.monotonic()

    async def _renew_held(self) -> None:
        if self._held is None:
            return
        if time.monotonic() - self._seen_s > UNSEEN_S:
            self.say("the button was let go by itself: the mouse said nothing for 2 s", True)
            await self.let_go()
            return
        await self._jog(*self._held)

    async def let_go(self) -> None:
        """Nothing is held any more: mouse up, focus lost."""
        held, self._held = self._held, None
        self._key.forget()
        for button in self.query(HeldButton):
            button.let_go()
        if held is not None or self.app.has_jogged:
            await self.app.operator.let_go(self.selected, self.app.arm.joint_count)

    def action_toggle_step(self) -> None:
        """Step or hold."""
        self.is_stepping = not self.is_stepping
        self._text_s = -1e9

    def action_step_size(self, by: int) -> None:
        """Smaller or larger steps."""
        self._step_at = min(max(self._step_at + by, 0), len(STEPS_rad) - 1)

    def action_jog_speed(self, by: int) -> None:
        """Jog slower or faster."""
        self.speed = _next(SPEEDS, self.speed, by)

    async def action_pace(self, by: int) -> None:
        """Motions slower or faster, the one that runs, too."""
        self.pace = _next(PACES, self.pace, by)
        await self.app.operator.line(f"override {self.pace:g}")

    # ---- lines

    async def action_line(self, text: str) -> None:
        """A line, as if it were typed."""
        await self.app.operator.line(text)

    @work
    async def action_home(self) -> None:
        """Find the zeros, after a question."""
        if await self.app.push_screen_wait(
            Confirm("Home: every joint moves to its switch. Is the way clear?")
        ):
            await self.app.operator.line("home")

    async def action_pause(self) -> None:
        """Pause, or go on."""
        status = self.app.link.status
        is_paused = status is not None and status["mode"] == "PAUSED"
        await self.app.operator.line("resume" if is_paused else "pause")

    async def action_record(self) -> None:
        """A way-point more."""
        await self.app.operator.line(f"teach {self.app.files.taught}")

    @work
    async def action_off(self) -> None:
        """Drives off, after a question."""
        if await self.app.push_screen_wait(
            Confirm("Stop, hold, lower the arm on shorted windings, drives off?")
        ):
            await self.app.operator.line("off")

    @work
    async def action_guide(self) -> None:
        """By hand: drives off, or with gravity compensation."""
        how = await self.app.push_screen_wait(Choose("Guide by hand", list(GUIDING)))
        if how is not None:
            await self.app.operator.line(GUIDING[how])

    @work
    async def action_go(self) -> None:
        """To a named place."""
        try:
            names = list(read_places(self.app.files.places))
        except PlacesError as error:
            self.say(str(error), True)
            return
        name = await self.app.push_screen_wait(Choose("Go to", names))
        if name is not None:
            await self.app.operator.line(f"go {name} --places {self.app.files.places}")

    @work
    async def action_keep(self) -> None:
        """This place by name."""
        name = await self.app.push_screen_wait(
            AskText("A name for where the arm stands (letters, digits, - and _)")
        )
        if name is not None:
            await self.app.operator.line(f"mark '{name}' --places {self.app.files.places}")

    @work
    async def action_run_file(self) -> None:
        """A way-point file."""
        file = await self.app.push_screen_wait(AskText("A way-point file to run", str(self.app.files.taught)))
        if file is None:
            return
        if not Path(file).is_file():
            self.say(f"{file}: no such file", True)
            return
        await self.app.operator.line(f"run '{file}'")

    @work
    async def action_calibrate(self) -> None:
        """The calibration session's screen; a folder that is there is resumed."""
        folder = self.app.files.sessions / time.strftime("%Y-%m-%d")
        options = f"--out {folder}" if folder.exists() else f"--out {folder} --setups normal,roll,pitch"
        question = (
            "Options of the session, as of `armwright session`. A session that is there needs --out alone."
        )
        line = await self.app.push_screen_wait(AskText(question, options))
        if line is not None:
            self.app.open_session(line)

    def action_command(self) -> None:
        """Into the command box, at once: what is typed next must not be taken for keys."""
        self.set_focus(self.query_one(CommandBox))

    def action_help(self) -> None:
        """The keys."""
        self.app.push_screen(HelpDialog())

    async def on_input_submitted(self, event: Input.Submitted) -> None:
        """A line of the command box."""
        event.stop()
        text = self.query_one(CommandBox).take()
        if text:
            await self.app.operator.line(text)
        await asyncio.sleep(0)


def _next(values: tuple[float, ...], now: float, by: int) -> float:
    at = min(range(len(values)), key=lambda i: abs(values[i] - now))
    return values[min(max(at + by, 0), len(values) - 1)]
