"""Writes pictures to one file each, to one common file, or shows them in windows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from calib.report.page import PICTURE_STYLE as STYLE
from console.visualisation.pictures import Picture
from console.visualisation.series import Series
from control.errors import ArmError
from control.files import make_whole
from control.progress import Advance

if TYPE_CHECKING:
    from matplotlib.figure import Figure, FigureBase

Report = Advance
WIDTH_in: Final = 10.4
DOTS_PER_in: Final = 110
WITHOUT_WINDOWS: Final = ("agg", "cairo", "pdf", "pgf", "ps", "svg", "template")
FORMS: Final = (".png", ".svg", ".pdf")


def _ignore_progress(what: str, done: float) -> None:
    """Progress without an observer."""


def write_each(
    folder: Path,
    pictures: Sequence[Picture],
    series: Series,
    joints: Sequence[int],
    report: Report = _ignore_progress,
) -> list[Path]:
    """Write one PNG per picture to `folder`; return the files. `report` gets each title and the share done."""
    files = [folder / f"{picture.name}.png" for picture in pictures]
    _require_free(files)
    folder.mkdir(parents=True, exist_ok=True)
    for k, (file, picture) in enumerate(zip(files, pictures, strict=True)):
        report(picture.title, k / len(pictures))
        _save(file, [picture], series, joints)
    return files


def write_sheet(file: Path, pictures: Sequence[Picture], series: Series, joints: Sequence[int]) -> list[Path]:
    """All pictures below each other in one file."""
    _require_free([file])
    file.parent.mkdir(parents=True, exist_ok=True)
    _save(file, pictures, series, joints)
    return [file]


def show(pictures: Sequence[Picture], series: Series, joints: Sequence[int]) -> None:
    """Show a window per picture; returns when all are closed. ArmError if no window can be opened."""
    import matplotlib
    import matplotlib.pyplot as plt

    backend = plt.get_backend()
    if backend.lower() in WITHOUT_WINDOWS:
        raise ArmError(
            f"cannot open a window (matplotlib found no display or toolkit, backend {backend}): write files with"
            " --out DIR, FILE.png or FILE.svg"
        )
    with matplotlib.rc_context(STYLE):
        for picture in pictures:
            figure = plt.figure(picture.title, figsize=(WIDTH_in, picture.height_in(joints)))
            _draw(figure, picture, series, joints)
        plt.show()


def _save(file: Path, pictures: Sequence[Picture], series: Series, joints: Sequence[int]) -> None:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    heights = [picture.height_in(joints) for picture in pictures]
    with rc_context(STYLE):
        figure: Figure = Figure(figsize=(WIDTH_in, sum(heights)))
        parts: list[FigureBase] = [figure]
        if len(pictures) > 1:
            stacked = figure.subfigures(len(pictures), 1, squeeze=False, height_ratios=heights)
            parts = [row[0] for row in stacked]
        for part, picture in zip(parts, pictures, strict=True):
            _draw(part, picture, series, joints)
        about = {"Date": None} if file.suffix == ".svg" else None
        make_whole(file, lambda beside: figure.savefig(beside, dpi=DOTS_PER_in, metadata=about))


def _draw(on: FigureBase, picture: Picture, series: Series, joints: Sequence[int]) -> None:
    on.suptitle(f"{picture.title}: {series.name}", x=0.01, y=0.995, ha="left", va="top", fontsize=10)
    picture.draw(on, series, joints)


def _require_free(files: Sequence[Path]) -> None:
    for file in files:
        if file.exists():
            raise ArmError(f"{file} exists already and is never overwritten: choose another --out")
