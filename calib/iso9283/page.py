"""iso9283.html: one file without any outside resource, a table of the fourteen criteria, pictures, every figure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from calib.inputs import InputFile
from calib.iso9283 import pictures
from calib.iso9283.result import Criterion, Evaluation, Figure
from calib.report.page import Cell, Section, bullets, page, table
from control.files import write_whole

SHOWN = {"m": (1e3, "mm", 3), "m/s": (1.0, "m/s", 4), "m/N": (1e6, "µm/N", 3), "rad": (1e3, "mrad", 3)}


def write_page(
    path: Path, evaluation: Evaluation, arm: str, date: str, program: str, inputs: Sequence[InputFile]
) -> None:
    """Write iso9283.html."""
    title = "Performance criteria of ISO 9283:1998"
    write_whole(path, page(title, arm, f"{date} · {program}", _sections(evaluation, inputs)))


def _sections(evaluation: Evaluation, inputs: Sequence[InputFile]) -> Iterator[Section]:
    criteria = evaluation.criteria
    had = sum(bool(c.figures) for c in criteria)
    yield Section(f"{had} of {len(criteria)} criteria", _summary(criteria) + bullets(evaluation.notes))
    if evaluation.clouds:
        yield Section(
            "Poses: attained positions about their barycentres", pictures.cloud_picture(evaluation.clouds)
        )
    if evaluation.paths:
        drawn = pictures.path_picture(evaluation.paths) + pictures.deviation_picture(evaluation.paths)
        yield Section("Paths", drawn)
    if evaluation.settling:
        yield Section("Coming to rest", pictures.settling_picture(evaluation.settling))
    yield Section("Every figure", _figures(criteria))
    yield Section(
        "Inputs",
        table(
            ("file", "what it is", "SHA-256"),
            [(i.name, ("text", i.what), ("text", i.sha256)) for i in inputs],
        ),
    )


def shown(value: float, unit: str) -> str:
    """Format a value in a readable unit."""
    scale, name, digits = SHOWN.get(unit, (1.0, unit, 3))
    return f"{scale * value:.{digits}f} {name}"


def _summary(criteria: Sequence[Criterion]) -> str:
    rows: list[Sequence[Cell]] = []
    for c in criteria:
        values = "; ".join(f"{f.symbol} = {shown(f.value, f.unit)} ({f.where})" for f in c.headlines)
        texts = (c.name, c.clause, values or "–", "; ".join(c.needs))
        rows.append((str(c.number), *(("text", cell) for cell in texts)))
    return _left(table(("", "criterion", "clause", "largest value", "still needs"), rows))


def _figures(criteria: Sequence[Criterion]) -> str:
    rows: list[Sequence[Cell]] = [
        (
            f"{c.number}  {f.symbol}",
            shown(f.value, f.unit),
            ("text", f.where),
            str(f.count),
            ("text", f.remark),
        )
        for c in criteria
        for f in c.figures
    ]
    return _left(table(("criterion, symbol", "value", "where", "cycles", "remark"), rows))


def _left(content: str) -> str:
    """A table with left-aligned headings."""
    return f'<div class="inputs">{content}</div>'


def summary_text(criteria: Sequence[Criterion]) -> str:
    """The criteria as lines of plain text."""
    lines = []
    for c in criteria:
        lines.append(f"{c.number:2d}  {c.name}")
        lines += [f"      {f.symbol:<14} {shown(f.value, f.unit):>16}   {_place(f)}" for f in c.headlines]
        lines += [f"      needs {need}" for need in c.needs]
    return "\n".join(lines)


def _place(figure: Figure) -> str:
    return f"{figure.where}; {figure.count} cycles"
