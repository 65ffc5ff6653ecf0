"""A panel of rows; only changed rows are redrawn."""

from collections.abc import Sequence
from typing import ClassVar

from rich.segment import Segment
from rich.style import Style
from textual.geometry import Region, Size
from textual.strip import Strip
from textual.widget import Widget

from console.screen.drawing.rows import LOOKS, Row, text_of


class Panel(Widget):
    """Rows with a title in the border."""

    COMPONENT_CLASSES: ClassVar[set[str]] = {f"look--{look}" for look in LOOKS}
    can_focus = False

    def __init__(self, id: str, title: str = "") -> None:  # noqa: A002 - as Textual calls it
        super().__init__(id=id)
        self.border_title = title
        self._shown: Sequence[Row] = ()
        # Textual works them out anew for each line, from all the widgets around this one.
        self._styles: dict[str, Style] = {}

    @property
    def text(self) -> str:
        """The contents, without styles."""
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
        base = self._style("")
        if y >= len(self._shown):
            return Strip.blank(width, base)
        segments = [Segment(text, self._style(look)) for text, look in self._shown[y]]
        return Strip(segments).adjust_cell_length(width, base)

    def notify_style_update(self) -> None:
        """The style sheet has changed what this panel looks like."""
        self._styles.clear()
        super().notify_style_update()

    def _style(self, look: str) -> Style:
        """Of a look; of the panel itself where the look has no name."""
        if look not in self._styles:
            found = self.get_component_rich_style(f"look--{look}") if look else self.rich_style
            self._styles[look] = found
        return self._styles[look]
