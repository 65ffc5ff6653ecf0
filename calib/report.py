"""report.html: one file without any outside resource that says what was done and what came out of it."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from calib.identify.identification import Estimate, Identification
from calib.pictures import histogram_picture, setup_picture, tracking_picture, vector_picture
from calib.report_data import InputFile, ReportData
from calib.verify import Comparison, ErrorSummary

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
th { color: var(--soft); font-weight: 600; border-bottom: 2px solid var(--line); }
th:first-child, td:first-child, .text, .inputs th { text-align: left; }
td.text { white-space: normal; }
tr.group td { border-top: 2px solid var(--line); }
.before { color: #A84A00; } .after { color: #005A8C; font-weight: 600; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(340px, 1fr)); gap: 12px; }
svg { width: 100%; height: auto; display: block; }
code { font: 12px ui-monospace, "DejaVu Sans Mono", monospace; overflow-wrap: anywhere; }
td code { white-space: normal; }
ul, ol { margin: 6px 0; padding-left: 22px; }
@media print { body { background: #fff; } section, .tile { break-inside: avoid; } }
"""

NO_EFFECT = 0.999  # share of a parameter that the data leave open, from which on it is said to have no effect
Cell = str | tuple[str, str]


def write_report(path: Path, report: ReportData) -> None:
    """Write report.html, making its folder if need be."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(report_html(report), encoding="utf-8")


def report_html(report: ReportData) -> str:
    """The whole page."""
    parts = [
        f"<h1>{_said(report.title)}</h1>",
        f'<p class="soft">arm <b>{_said(report.arm)}</b> · {_said(report.date)} ·'
        f" {_said(report.program_version)}</p>",
        _tiles(report),
        _done(report),
        *_verification(report.verification),
        *_tracking(report),
        *_parameters(report.identification),
        *_calibration(report.calibration),
        *_inputs(report.inputs),
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_said(report.title)}: {_said(report.arm)}</title><style>{STYLE}</style></head>\n"
        f"<body><main>{''.join(parts)}</main></body></html>\n"
    )


def _said(text: str) -> str:
    return html.escape(text)


def _section(title: str, *parts: str) -> str:
    return f"<section><h2>{_said(title)}</h2>{''.join(parts)}</section>\n"


def _list(lines: Iterable[str], kind: str = "ul") -> str:
    return f"<{kind}>{''.join(f'<li>{_said(line)}</li>' for line in lines)}</{kind}>"


def _table(header: Sequence[str], rows: Iterable[Sequence[Cell]]) -> str:
    """A table; a cell is text, or (class, text)."""
    head = "".join(f"<th>{_said(name)}</th>" for name in header)
    body = "".join(f"<tr>{''.join(_cell(cell) for cell in row)}</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _cell(cell: Cell) -> str:
    if isinstance(cell, str):
        return f"<td>{_said(cell)}</td>"
    return f'<td class="{cell[0]}">{_said(cell[1])}</td>'


def _tiles(report: ReportData) -> str:
    """The result in three figures."""
    tiles = []
    judged = report.verification or report.calibration
    if judged is not None:
        entry = judged.of("all")
        where = "at points not used" if report.verification is not None else "at the calibration points"
        tiles += [
            ("before", f"{1e3 * entry.before.mean_m:.2f} mm", f"mean error before, {where}"),
            ("after", f"{1e3 * entry.after.mean_m:.2f} mm", f"mean error after, {where}"),
            ("", f"{entry.improvement_percent:.1f} %", f"smaller mean error, {where}"),
        ]
    found = report.identification
    if found is not None:
        tiles.append(
            ("", f"{found.rank} of {len(found.estimates)}", "DH parameters that the points determine")
        )
    boxes = "".join(
        f'<div class="tile"><b class="{kind}">{_said(figure)}</b><span class="soft small">{_said(what)}</span></div>'
        for kind, figure, what in tiles
    )
    return f'<div class="tiles">{boxes}</div>\n'


def _done(report: ReportData) -> str:
    notes = f"<h3>To note</h3>{_list(report.notes)}" if report.notes else ""
    return _section("What was done", _list(report.steps, "ol"), notes)


def _inputs(inputs: tuple[InputFile, ...]) -> list[str]:
    if not inputs:
        return []
    rows: list[Sequence[Cell]] = [(file.name, ("text", file.what), ("text", file.sha256)) for file in inputs]
    return [
        _section("Inputs", '<div class="inputs">', _table(("file", "what it is", "SHA-256"), rows), "</div>")
    ]


def _verification(comparison: Comparison | None) -> list[str]:
    if comparison is None:
        return []
    return [
        _section(
            "Error before and after, at points that calibration did not use",
            _comparison_table(comparison),
            vector_picture(comparison),
            f'<div class="pair">{histogram_picture(comparison)}{setup_picture(comparison)}</div>',
            _points_table(comparison),
        )
    ]


def _calibration(comparison: Comparison | None) -> list[str]:
    if comparison is None:
        return []
    return [
        _section(
            "At the calibration points",
            '<p class="soft">These points made the result, so they flatter it; judge by the points above.</p>',
            _comparison_table(comparison),
            vector_picture(comparison),
            f'<div class="pair">{histogram_picture(comparison)}{setup_picture(comparison)}</div>',
        )
    ]


def _comparison_table(comparison: Comparison) -> str:
    header = (
        "setup",
        "points",
        "",
        "mean [mm]",
        "95 % of the mean [mm]",
        "RMS [mm]",
        "max [mm]",
        "sd [mm]",
        "improved",
    )
    rows: list[Sequence[Cell]] = []
    for entry in comparison.by_setup():
        rows.append((entry.setup, str(entry.before.count), ("before", "before"), *_figures(entry.before), ""))
        rows.append(
            ("", "", ("after", "after"), *_figures(entry.after), f"{entry.improvement_percent:.1f} %")
        )
    return _table(header, rows)


def _figures(summary: ErrorSummary) -> tuple[str, ...]:
    interval = "" if math.isnan(summary.mean_half_width_m) else f"± {1e3 * summary.mean_half_width_m:.3f}"
    spread = "" if math.isnan(summary.sd_m) else f"{1e3 * summary.sd_m:.3f}"
    return (
        f"{1e3 * summary.mean_m:.3f}",
        interval,
        f"{1e3 * summary.rms_m:.3f}",
        f"{1e3 * summary.max_m:.3f}",
        spread,
    )


def _points_table(comparison: Comparison) -> str:
    """Every point, folded away."""
    rows: list[Sequence[Cell]] = []
    for k, (setup, point) in enumerate(zip(comparison.setup, comparison.point, strict=True)):
        x, y, z = (f"{1e3 * v:.1f}" for v in comparison.tip_m[k])
        before, after = (f"{1e3 * math.hypot(*e[k]):.3f}" for e in (comparison.before_m, comparison.after_m))
        rows.append((setup, ("text", point), x, y, z, ("before", before), ("after", after)))
    table = _table(("setup", "point", "x [mm]", "y [mm]", "z [mm]", "before [mm]", "after [mm]"), rows)
    return f'<details><summary class="soft">all {len(rows)} points</summary>{table}</details>'


def _tracking(report: ReportData) -> list[str]:
    """Planned and measured paths."""
    if not report.tracks:
        return []
    pictures = "".join(f"<h3>{_said(track.name)}</h3>{tracking_picture(track)}" for track in report.tracks)
    return [_section("Tracking: planned and measured tip", pictures)]


def _parameters(found: Identification | None) -> list[str]:
    if found is None:
        return []
    header = ("parameter", "unit", "nominal", "identified", "deviation", "sd", "bound", "")
    rows = [_parameter_row(estimate) for estimate in found.estimates]
    before, after = found.objective_before, found.objective_after
    return [
        _section(
            "DH parameters",
            f"<p>Objective {_said(found.objective)}: {before:.6g} before, {after:.6g} after (SI units). Left at the points"
            f": {1e3 * found.noise_m:.3f} mm per axis (standard deviation).</p>",
            "<h3>What the data determine, and what they do not</h3>",
            _list(found.in_words()),
            _table(header, rows),
            '<p class="soft small">sd: standard deviation of what the data determine of this parameter. Where parameters'
            " move together, only their combination has a meaning; the values given are those nearest to nominal.</p>",
        )
    ]


def _parameter_row(estimate: Estimate) -> Sequence[Cell]:
    parameter = estimate.parameter
    unit, scale, digits = ("mm", 1e3, 3) if parameter.unit == "m" else ("deg", math.degrees(1.0), 4)
    is_open = estimate.undetermined_share > NO_EFFECT
    sd = "" if math.isnan(estimate.sd) or is_open else f"{scale * estimate.sd:.{digits}f}"
    return (
        parameter.name,
        unit,
        f"{scale * parameter.nominal:.{digits}f}",
        ("after", f"{scale * estimate.value:.{digits}f}"),
        f"{scale * estimate.deviation + 0.0:+.{digits}f}",
        sd,
        f"± {scale * parameter.bound:.{digits}g}",
        ("text", _remark(estimate)),
    )


def _remark(estimate: Estimate) -> str:
    said = []
    if estimate.undetermined_share > NO_EFFECT:
        said.append("no effect, kept at nominal")
    elif not estimate.is_determined:
        said.append("moves together with others")
    if estimate.is_at_bound:
        said.append("at its bound")
    return ", ".join(said)
