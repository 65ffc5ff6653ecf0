"""What the console shows of the arm: panels that follow its state, buttons that are held, and the command box."""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import ClassVar

from textual import events
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.message import Message
from textual.widgets import Input, Static

from console.screen import drawing, texts
from console.screen.jogging import Jogger
from console.screen.operator import JogTarget, RuntimeLink, ScreenOperator
from console.user_config import shows_degrees
from control.model.arm import Arm
from control.server.channel import Message as Status


class HeldButton(Static):
    """A button that posts a message when the mouse goes down on it, and when it is released or leaves."""

    class Held(Message):
        """The button was pressed or released."""

        def __init__(self, target: JogTarget, sign: int, is_down: bool) -> None:
            super().__init__()
            self.target, self.sign, self.is_down = target, sign, is_down

    def __init__(self, target: JogTarget, sign: int) -> None:
        super().__init__("−" if sign < 0 else "+", classes="held minus" if sign < 0 else "held plus")
        self._target, self._sign, self._is_down = target, sign, False

    def on_mouse_down(self, event: events.MouseDown) -> None:
        """Press the button."""
        event.stop()
        self._is_down = True
        self.capture_mouse()
        self.post_message(self.Held(self._target, self._sign, True))

    def on_mouse_up(self, event: events.MouseUp) -> None:
        """Release the button."""
        event.stop()
        self.let_go()

    def on_mouse_release(self, _: events.MouseRelease) -> None:
        """Release the button: another widget has the mouse."""
        self.let_go()

    def let_go(self) -> None:
        """Release the button, for whatever reason."""
        if self._is_down:
            self._is_down = False
            self.release_mouse()
            self.post_message(self.Held(self._target, self._sign, False))


class PressButton(Static):
    """A button that runs one of the screen's actions."""

    def __init__(self, label: str, action: str, **keys: str) -> None:
        super().__init__(f" {label} ", classes="press", **keys)  # type: ignore[arg-type]
        self._action = action

    async def on_click(self, event: events.Click) -> None:
        """Do it."""
        event.stop()
        await self.screen.run_action(self._action)


class JogPad(Vertical):
    """The stop and the state of the keys; below, a pair of held buttons for each joint and axis."""

    def __init__(self, targets: list[JogTarget]) -> None:
        super().__init__(id="pad")
        self._targets = targets

    def compose(self) -> ComposeResult:
        """Buttons in two rows; those of the targets have equal widths."""
        with Horizontal(id="buttons"):
            yield PressButton("■ STOP", "app.stop", id="stop")
            yield PressButton("pause", "pause")
            yield PressButton("home", "home")
            yield drawing.Panel("jog")
        with Horizontal(id="targets"):
            for target in self._targets:
                with Horizontal(classes="target"):
                    yield HeldButton(target, -1)
                    yield Static(target.name, classes="name")
                    yield HeldButton(target, 1)


BOX_HINT = ": a line, as in `armwright script`, e.g. jog --joint 1 --by 0.05"
BOX_HINT_FOCUSED = "keys are typed here; Escape or an empty Enter gives them back to the arm"


class CommandBox(Input):
    """The command line. Escape leaves it; up and down recall earlier lines."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "leave", show=False),
        Binding("up", "recall(-1)", show=False),
        Binding("down", "recall(1)", show=False),
    ]

    def __init__(self, hint: str = BOX_HINT, focused_hint: str = BOX_HINT_FOCUSED) -> None:
        super().__init__(placeholder=hint, id="command", compact=True)
        self._hint, self._focused_hint = hint, focused_hint
        self._lines: list[str] = []
        self._at = 0

    def on_focus(self) -> None:
        """Say how to get out, as long as nothing is typed."""
        self.placeholder = self._focused_hint

    def on_blur(self) -> None:
        """Say what it is for."""
        self.placeholder = self._hint

    async def action_submit(self) -> None:
        """Send the line and clear the box at once: keys that are typed before it is handled belong to the next line."""
        text, self.value = self.value.strip(), ""
        if text:
            self._lines.append(text)
        self._at = len(self._lines)
        self.post_message(self.Submitted(self, text))

    def action_leave(self) -> None:
        """Return to the jog keys."""
        self.screen.set_focus(None)

    def action_recall(self, by: int) -> None:
        """Recall an earlier or a later line."""
        self._at = min(max(self._at + by, 0), len(self._lines))
        self.value = self._lines[self._at] if self._at < len(self._lines) else ""
        self.cursor_position = len(self.value)


TEXT_S, VIEW_S, PLOT_S = 0.3, 0.3, 0.9  # multiples, so that updates coincide and are drawn in one pass
STILL_rad = 1e-3  # smaller changes of pose are not redrawn
PanelSize = Callable[[str], tuple[int, int]]  # columns and rows inside a panel
Drawn = tuple[str, Sequence[drawing.Row]]  # a panel's name and its rows


class Dashboard:
    """Computes from each status the rows of the panels that are due."""

    def __init__(self, arm: Arm, operator: ScreenOperator, jogger: Jogger) -> None:
        self.override = 1.0
        self.in_degrees = shows_degrees()
        self.arm, self.operator, self.jogger = arm, operator, jogger
        self._link: RuntimeLink = operator.link
        self._skeleton = drawing.Skeleton(arm)
        self._history = drawing.History()
        self._last: Status | None = None
        self._drawn_s: dict[str, float] = {}
        self._view: tuple[object, ...] = ()
        joints = tuple(str(j + 1) for j in range(arm.joint_count))
        self._plots: dict[str, tuple[drawing.BinnedSeries, Callable[[drawing.BinnedSeries, int], drawing.Plot]]] = {
            "error": (self._history.error_mrad, functools.partial(_plot, joints, 1.0, True)),
            "current": (self._history.current_A, functools.partial(_plot, joints, 0.5, True)),
            "speed": (self._history.tip_mm_s, functools.partial(_plot, ("",), 10.0, False)),
            "late": (self._history.late_us, functools.partial(_plot, ("",), 100.0, False)),
        }

    def panels(self) -> Iterator[drawing.Panel]:
        """The panels of the arm and of its values over time."""
        yield drawing.Panel("side", "Side: x, z m")
        yield drawing.Panel("top", "Top: x, y m")
        yield drawing.Panel("error", f"Error mrad, limit {1e3 * self.arm.limits.following_error_rad:g}")
        yield drawing.Panel("current", f"Current A, limit {max(d.current_limit_A for d in self.arm.drives):g}")
        yield drawing.Panel("speed", "Tip speed mm/s")
        yield drawing.Panel("late", "Loop lateness p99 us")

    def hurry(self) -> None:
        """Update all panels with the next status, after a key."""
        self._drawn_s.clear()

    def events(self, status: Status | None) -> list[texts.Event]:
        """Events since the last status; stores this one."""
        events = texts.events_between(self._last, status, self._link.why_lost)
        self._last = status
        return events

    def changed(self, status: Status | None, room: PanelSize, now_s: float) -> Iterator[Drawn]:
        """The panels that are due, with their rows."""
        if status is not None:
            self._history.add(status)
            self.override = status["override"]
        if self._is_due("texts", TEXT_S, now_s) or status is None:
            yield from self._texts(status, room)
        if status is not None and self._is_due("views", VIEW_S, now_s):
            yield from self._views(status, room)
        if status is not None and self._is_due("plots", PLOT_S, now_s):
            yield from self._drawn_plots(room)

    def _is_due(self, what: str, period_s: float, now_s: float) -> bool:
        if now_s - self._drawn_s.get(what, -1e9) < period_s:
            return False
        self._drawn_s[what] = now_s
        return True

    def _texts(self, status: Status | None, room: PanelSize) -> Iterator[Drawn]:
        arm, selected, why_lost = self.arm, self.jogger.selected.name, self._link.why_lost
        yield "head", [texts.headline(status, arm, why_lost, room("head")[0], drawing.clock())]
        yield "status", texts.status_rows(status, why_lost, room("status")[0])
        if status is not None:
            width = room("joints")[0]
            joints = texts.joint_rows(status, arm, selected, width, self.in_degrees)
            yield "joints", [*joints, texts.tip_row(status, selected), *texts.end_rows(status, width)]
        yield "jog", [self._jog_row()]

    def _jog_row(self) -> drawing.Row:
        command = self.operator.running.partition(" ")[0]
        running = drawing.row(("  running: ", "muted"), command) if command else ()
        return (*self.jogger.describe(), *drawing.row(("  override ", "muted"), f"{100 * self.override:g} %"), *running)

    def _views(self, status: Status, room: PanelSize) -> Iterator[Drawn]:
        is_stale = [age is not None for age in texts.stale_s(status)]
        pose = [round(q / STILL_rad) for q in status["joint_rad"]] if status["is_homed"] else []
        selected = self.jogger.selected.joint
        view = (pose, is_stale, selected, room("side"), room("top"))
        if view == self._view:
            return
        self._view = view
        scene = drawing.DrawnScene([], [], self._skeleton.board)
        if status["is_homed"]:
            scene = self._skeleton.scene(status["joint_rad"], selected and selected - 1, is_stale)
        for name, axes in (("side", drawing.SIDE), ("top", drawing.TOP)):
            columns, rows = room(name)
            if columns > 8 and rows > 2:
                yield name, drawing.view(scene, axes, columns, rows, self._skeleton.reach_m)

    def _drawn_plots(self, room: PanelSize) -> Iterator[Drawn]:
        for name, (series, plot) in self._plots.items():
            if room(name)[0]:
                yield (name, drawing.plot_rows(plot(series, (self.jogger.selected.joint or 1) - 1), *room(name)))


def _plot(signs: Sequence[str], least: float, is_signed: bool, series: drawing.BinnedSeries, chosen: int) -> drawing.Plot:
    return drawing.Plot(series.bins, signs, chosen if len(signs) > 1 else 0, least, is_signed)
