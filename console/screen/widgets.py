"""The console's own widgets: buttons that are held, and the command box."""

from typing import ClassVar

from textual import events
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.message import Message
from textual.widgets import Input, Static

from console.screen.drawing import Panel
from console.screen.operator import JogTarget


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
            yield Panel("jog")
        with Horizontal(id="targets"):
            for target in self._targets:
                with Horizontal(classes="target"):
                    yield HeldButton(target, -1)
                    yield Static(target.name, classes="name")
                    yield HeldButton(target, 1)


BOX_HINT = ": a line, as in `armwright script`, e.g. jog --joint 1 --by 0.05"
BOX_HINT_FOCUSED = "keys are typed here: Escape, or Enter in the empty box, gives them back to the arm"


class CommandBox(Input):
    """The command line. Escape leaves it; up and down recall earlier lines."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "leave", show=False),
        Binding("up", "recall(-1)", show=False),
        Binding("down", "recall(1)", show=False),
    ]

    def __init__(self, hint: str = BOX_HINT, focused_hint: str = BOX_HINT_FOCUSED) -> None:
        super().__init__(
            placeholder=hint,
            id="command",
            compact=True,
        )
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
