"""Modal dialogs. Space stops the arm in them, too."""

from collections.abc import Sequence
from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical
from textual.screen import ModalScreen
from textual.widgets import Input, OptionList, Static

# No line is wider than 66: a terminal of 80 columns shows it whole.
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
