"""A scrolling log: lines with the local time, wrapped to the panel's width."""

import time
from collections import deque

from rich.text import Text
from textual import events
from textual.widgets import RichLog

from console.screen.drawing.rows import LOOKS, Row, row, wrapped

LONGEST = 500  # entries; older ones are dropped


def clock(now_s: float | None = None) -> str:
    """Local time of day, now or at a Unix time."""
    return time.strftime("%H:%M:%S", time.localtime(now_s))


class EventLog(RichLog, can_focus=False):
    """Entries with an optional time. It follows the latest entry until it is scrolled up."""

    COMPONENT_CLASSES = {f"look--{look}" for look in LOOKS}  # noqa: RUF012 - as Textual declares it

    def __init__(self, id: str, title: str) -> None:  # noqa: A002 - as Textual calls it
        super().__init__(id=id, min_width=8)
        self.border_title = title
        self._entries: deque[tuple[str, str, str]] = deque(maxlen=LONGEST)
        self._width = 0

    @property
    def text(self) -> str:
        """The entries, without wrapping."""
        return "\n".join(f"{at} {text}".strip() for at, text, _ in self._entries)

    def add(self, text: str, look: str = "plain", at: str = "") -> None:
        """Add an entry, with the time `at` before it."""
        for one in text.splitlines() or [""]:
            self._entries.append((at, one, look))
            if self._width:
                self._draw(at, one, look)

    def on_resize(self, event: events.Resize) -> None:
        """Wrap again."""
        super().on_resize(event)
        if (width := self.scrollable_content_region.width) != self._width:
            self._width = width
            self.clear()
            for entry in self._entries:
                self._draw(*entry)

    def _draw(self, at: str, text: str, look: str) -> None:
        is_following = self.is_vertical_scroll_end
        indent = len(at) + 1 if at else 0
        for n, spans in enumerate(wrapped(text, look, self._width - indent, "! " if look == "error" else "")):
            start = row((f"{at} " if n == 0 and at else " " * indent, "muted"))
            self.write(self._styled((*start, *spans)), scroll_end=is_following)

    def _styled(self, spans: Row) -> Text:
        parts = ((text, self.get_component_rich_style(f"look--{look}", partial=True)) for text, look in spans)
        return Text.assemble(*parts, no_wrap=True)
