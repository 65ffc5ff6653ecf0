"""One HTML page without any outside resource, of sections and pictures as inline SVG; every text is escaped here."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


STYLE = """
:root { --ink: #1d2430; --soft: #5b6470; --line: #dfe4ea; --blue: #0072B2; --orange: #D55E00; }
* { box-sizing: border-box; }
body { margin: 0; background: #f3f5f8; color: var(--ink); font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 28px 20px 60px; }
h1 { font-size: 26px; margin: 0 0 2px; } h2 { font-size: 18px; margin: 0 0 10px; } h3 { font-size: 15px; margin: 18px 0 6px; }
.soft { color: var(--soft); } .small { font-size: 13px; }
section { background: #fff; border: 1px solid var(--line); border-radius: 10px; padding: 18px 22px; margin-top: 18px; }
.tiles { display: flex; flex-wrap: wrap; gap: 14px; margin-top: 18px; }
.tile { flex: 1 1 200px; background: #fff; border: 1px solid var(--line); border-radius: 10px; padding: 12px 16px; }
.tile b { display: block; font-size: 25px; line-height: 1.25; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: 14px; }
th, td { padding: 4px 10px; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th { color: var(--soft); font-weight: 600; border-bottom: 2px solid var(--line); vertical-align: bottom; white-space: normal; }
th:first-child, td:first-child, .text, .inputs th { text-align: left; }
td.text { white-space: normal; }
.verdict { border-left: 5px solid var(--blue); } .verdict p { margin: 4px 0; font-size: 16px; }
tr.group td { border-top: 2px solid var(--line); }
.before { color: #A84A00; } .after { color: #005A8C; font-weight: 600; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(340px, 1fr)); gap: 12px; }
svg { width: 100%; height: auto; display: block; }
code { font: 12px ui-monospace, "DejaVu Sans Mono", monospace; overflow-wrap: anywhere; }
td code { white-space: normal; }
ul, ol { margin: 6px 0; padding-left: 22px; }
@media print { body { background: #fff; } section, .tile { break-inside: avoid; } }
"""

Cell = str | tuple[str, str]
"""Text, or (class, text)."""


@dataclass(frozen=True, slots=True)
class Section:
    """A box of the page: a title, and its content as escaped HTML."""

    title: str
    html: str


def page(title: str, arm: str, about: str, parts: Iterable[Section | str]) -> str:
    """The whole page: a heading, then sections and other HTML in order."""
    body = "".join(part if isinstance(part, str) else _box(part) for part in parts)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escaped(title)}: {escaped(arm)}</title><style>{STYLE}</style></head>\n"
        f"<body><main><h1>{escaped(title)}</h1>"
        f'<p class="soft">arm <b>{escaped(arm)}</b> · {escaped(about)}</p>{body}</main></body></html>\n'
    )


def _box(section: Section) -> str:
    return f"<section><h2>{escaped(section.title)}</h2>{section.html}</section>\n"


def list_section(title: str, lines: Iterable[str]) -> Section:
    """A section of plain sentences, one bullet each."""
    return Section(title, bullets(lines))


def escaped(text: str) -> str:
    """Text as HTML."""
    return html.escape(text)


def paragraph(text: str, kind: str = "") -> str:
    """One paragraph; `kind` is a class of the style."""
    return f'<p class="{kind}">{escaped(text)}</p>' if kind else f"<p>{escaped(text)}</p>"


def heading(text: str) -> str:
    """A heading within a section."""
    return f"<h3>{escaped(text)}</h3>"


def bullets(lines: Iterable[str], kind: str = "ul") -> str:
    """A list, `ul` or `ol`."""
    return f"<{kind}>{''.join(f'<li>{escaped(line)}</li>' for line in lines)}</{kind}>"


def folded(title: str, content: str, is_open: bool = False) -> str:
    """HTML that a click unfolds."""
    return f'<details{" open" if is_open else ""}><summary class="soft">{escaped(title)}</summary>{content}</details>'


def pair(left: str, right: str) -> str:
    """Two pieces of HTML, side by side if there is room."""
    return f'<div class="pair">{left}{right}</div>'


def table(header: Sequence[Cell], rows: Iterable[Sequence[Cell]]) -> str:
    """A table; a cell is text, or (class, text)."""
    head = "".join(_cell(cell, "th") for cell in header)
    body = "".join(f"<tr>{''.join(_cell(cell) for cell in row)}</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def tiles(figures: Iterable[tuple[str, str, str]]) -> str:
    """Results as large figures: class, figure, label."""
    boxes = "".join(
        f'<div class="tile"><b class="{kind}">{escaped(figure)}</b><span class="soft small">{escaped(what)}</span></div>'
        for kind, figure, what in figures
    )
    return f'<div class="tiles">{boxes}</div>\n'


def verdict(sentences: Iterable[str]) -> str:
    """The verdict as sentences, at the top."""
    return f'<section class="verdict">{"".join(paragraph(text) for text in sentences)}</section>\n'


def _cell(cell: Cell, kind: str = "td") -> str:
    if isinstance(cell, str):
        return f"<{kind}>{escaped(cell)}</{kind}>"
    return f'<{kind} class="{cell[0]}">{escaped(cell[1])}</{kind}>'


# Drawing of pictures as inline SVG, in one style, without a window system or global state.
#
# Every axis has its unit; colours are Okabe and Ito's, safe for colour-blind readers, and curves never differ by
# colour alone.


BEFORE, AFTER, PLANNED = "#D55E00", "#0072B2", "#5B6470"
NAMES = "xyz"
PICTURE_STYLE: Any = {  # matplotlib's stubs want a literal for every key
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


CLOUD, CLOUD_dpi = 500, 160  # dots of one line


def svg(size_in: tuple[float, float], draw: Callable[[Figure], None]) -> str:
    """An inline <svg> of what `draw` draws on a figure.

    `draw` places its axes itself: matplotlib's own layout draws everything several times. Clouds of dots become pixels: an
    element each made a page of a long recording 39 MB.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    with rc_context(PICTURE_STYLE):
        figure = Figure(figsize=size_in)
        draw(figure)
        for line in figure.findobj(Line2D):
            if line.get_linestyle() == "None" and np.size(line.get_xdata()) > CLOUD:
                line.set_rasterized(True)
        text = io.StringIO()
        figure.savefig(text, format="svg", dpi=CLOUD_dpi, metadata={"Date": None, "Creator": None})
    return _inline(text.getvalue())


def _inline(page: str) -> str:
    """Remove XML header and metadata; the size is the largest, so that all pictures have the same text; add a fallback font."""
    text = re.sub(r"<metadata>.*?</metadata>", "", page[page.index("<svg") :], flags=re.S)
    head, rest = text.split(">", 1)
    head = re.sub(r' width="([^"]*)" height="[^"]*"', r' style="max-width: \1"', head.replace("\n", " "))
    return head + ">" + rest.replace("'DejaVu Sans'", "'DejaVu Sans', Verdana, sans-serif")


def label_plane(axes: Axes, i: int, j: int, title: str) -> None:
    """Axes of two coordinates in mm."""
    axes.set(xlabel=f"{NAMES[i]} [mm]", ylabel=f"{NAMES[j]} [mm]")
    axes.set_title(title, loc="left")
