"""Drawing of pictures as inline SVG, in one style, without a window system or global state.

Every axis has its unit; colours are Okabe and Ito's, safe for colour-blind readers, and curves never differ by
colour alone.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BEFORE, AFTER, PLANNED = "#D55E00", "#0072B2", "#5B6470"
NAMES = "xyz"
STYLE: Any = {  # matplotlib's stubs want a literal for every key
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#8A929C",
    "axes.grid": True,
    "grid.color": "#E3E7EC",
    "grid.linewidth": 0.7,
    "axes.axisbelow": True,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "svg.fonttype": "none",  # text stays text: half the size, drawn in half the time, and it can be searched
    "svg.hashsalt": "armwright",
}


def svg(size_in: tuple[float, float], draw: Callable[[Figure], None]) -> str:
    """An inline <svg> of what `draw` draws on a figure.

    `draw` places its axes itself: matplotlib's own layout draws everything several times.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=size_in)
        draw(figure)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return _inline(text.getvalue())


def _inline(page: str) -> str:
    """Remove XML header, metadata and fixed size; add a fallback font."""
    text = re.sub(r"<metadata>.*?</metadata>", "", page[page.index("<svg") :], flags=re.S)
    head, rest = text.split(">", 1)
    head = re.sub(r' (?:width|height)="[^"]*"', "", head)
    return head + ">" + rest.replace("'DejaVu Sans'", "'DejaVu Sans', Verdana, sans-serif")


def label_plane(axes: Axes, i: int, j: int, title: str) -> None:
    """Axes of two coordinates in mm."""
    axes.set(xlabel=f"{NAMES[i]} [mm]", ylabel=f"{NAMES[j]} [mm]")
    axes.set_title(title, loc="left")
