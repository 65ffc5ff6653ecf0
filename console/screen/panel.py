"""A panel of rows on the screen, of which only those that have changed are drawn."""

from collections.abc import Sequence
from typing import ClassVar

from rich.segment import Segment
from rich.style import Style
from textual.geometry import Region, Size
from textual.strip import Strip
from textual.widget import Widget

from console.screen.rows import LOOKS, Row, text_of


class Panel(Widget):
    """Rows with a title in the border."""

    COMPONENT_CLASSES: ClassVar[set[str]] = {f"look--{look}" for look in LOOKS}
    can_focus = False

    def __init__(self, id: str, title: str = "") -> None:  # noqa: A002 - as Textual calls it
        super().__init__(id=id)
        self.border_title = title
        self._shown: Sequence[Row] = ()

    @property
    def text(self) -> str:
        """What it shows, without looks."""
        return text_of(self._shown)

    def show(self, rows: Sequence[Row]) -> None:
        """Show these rows."""
        before, self._shown = self._shown, rows
        height = self.styles.height
        if len(before) != len(rows) and height is not None and height.is_auto:
            self.refresh(layout=True)
            return
        for y in range(max(len(before), len(rows))):
            if before[y : y + 1] != rows[y : y + 1]:
                self.refresh(Region(0, y, self.size.width, 1))

    def get_content_height(self, container: Size, viewport: Size, width: int) -> int:
        """As many lines as there are rows."""
        return len(self._shown)

    def render_line(self, y: int) -> Strip:
        """One row."""
        width = self.size.width
        base = self.rich_style
        if y >= len(self._shown):
            return Strip.blank(width, base)
        segments = [Segment(text, self._look(look)) for text, look in self._shown[y]]
        return Strip(segments).adjust_cell_length(width, base)

    def _look(self, look: str) -> Style:
        return self.get_component_rich_style(f"look--{look}")
