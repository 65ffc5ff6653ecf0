"""A target as a PDF page of its true size."""

from __future__ import annotations

import io
from pathlib import Path

from calib.points.writer import replace_file
from calib.vision.targets import Charuco, Tags

DOTS_A_METRE = 12_000  # an edge is within 0.04 mm
MARGIN_m = 0.01
INCH_m = 0.0254


def write_print(path: Path, target: Charuco | Tags) -> Path:
    """Write the page; it is as large as the target with a white margin of 10 mm."""
    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.figure import Figure

    picture = target.drawn(DOTS_A_METRE, MARGIN_m)
    height, width = picture.shape
    figure = Figure(figsize=(width / DOTS_A_METRE / INCH_m, height / DOTS_A_METRE / INCH_m))
    FigureCanvasPdf(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.imshow(picture, cmap="gray", vmin=0, vmax=255, interpolation="none", aspect="auto")
    content = io.BytesIO()
    figure.savefig(content, format="pdf", dpi=DOTS_A_METRE * INCH_m)
    replace_file(path, content.getvalue())
    return path
