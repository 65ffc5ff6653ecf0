"""report.html: procedure and results in one file without outside resources.

`report_html` has the sections in their usual order. `report_sections` has single sections;
`page.page` makes a page of any sections.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arm_problem.observations import rotation_vector
from calib.arm_problem.parallel_axes import in_the_same_rows
from calib.arrays import Array, norms
from calib.identify.identification import Estimate, Identification
from calib.report.page import Cell, Section, bullets, escaped, folded, heading, page, pair, paragraph, table, tiles, verdict
from calib.report.pictures import histogram_picture, path_picture, setup_picture, vector_picture
from calib.results import InputFile, Provenance, entries, write_json
from calib.validation.holdout import HeldOut
from calib.validation.statistics import Difference, ErrorSummary, PairedFinding, digits_mm, improvement_percent
from calib.validation.verify import ALL, PARTS, Comparison, SetupComparison, TrackPair, TurnComparison, compare_tracks, findings
from control.errors import ArmError
from control.files import write_whole
from control.model.arm import Arm

NO_EFFECT = 0.999  # undetermined share from which a parameter is reported to have no effect
# Display of parameters by unit: unit, scale, format.
UNITS = {"m": ("mm", 1e3, ".3f"), "rad": ("deg", math.degrees(1.0), ".4f"), "1": ("", 1.0, ".6f")}


def done_section(steps: Iterable[str], notes: Sequence[str] = ()) -> Section:
    """The steps in order, and notes."""
    return Section("What was done", bullets(steps, "ol") + (heading("To note") + bullets(notes) if notes else ""))


def inputs_section(inputs: Sequence[InputFile]) -> Section:
    """The files that the result depends on."""
    rows: list[Sequence[Cell]] = [(file.name, ("text", file.what), ("text", file.sha256)) for file in inputs]
    return Section("Inputs", f'<div class="inputs">{table(("file", "what it is", "SHA-256"), rows)}</div>')


def parameters_section(fit: Identification) -> Section:
    """All parameters with their standard deviations, and what the data do not determine."""
    header = ("parameter", "unit", "nominal", "identified", "deviation", "sd", "bound", "")
    before, after = fit.objective_before, fit.objective_after
    return Section(
        "Parameters",
        f"<p>Objective {escaped(fit.objective)}: {before:.6g} before, {after:.6g} after (SI units). Residual"
        f" {1e3 * fit.noise_m:.3f} mm per axis (standard deviation).</p>"
        + heading("What the data determine")
        + bullets(fit.in_words())
        + table(header, [_parameter_row(estimate) for estimate in of_the_arm(fit)])
        + paragraph(
            "sd: standard deviation of the part of this parameter that the data determine. Where parameters move together,"
            " only their combination is meaningful; the values are those nearest to nominal.",
            "soft small",
        ),
    )


def of_the_arm(fit: Identification) -> tuple[Estimate, ...]:
    """The estimates without those of boards and base, which are meaningful only as whole frames."""
    free = [frame for frame in fit.solution.frames if frame.is_free]
    of_frames = {name for frame in free for name in frame.parameter_names}
    return tuple(one for one in fit.estimates if one.parameter.name not in of_frames)


def frames_section(fit: Identification) -> Section:
    """Identified poses of boards and base."""
    rows = [
        (
            frame.name,
            *(f"{1e3 * value:.3f}" for value in frame.origin_m.tolist()),
            *(f"{math.degrees(value):.3f}" for value in rotation_vector(frame.rotation).tolist()),
        )
        for frame in fit.solution.frames
        if frame.is_free
    ]
    header = ("frame", "x [mm]", "y [mm]", "z [mm]", "rx [deg]", "ry [deg]", "rz [deg]")
    return Section(
        "Poses of boards and base",
        paragraph("Identified with the parameters; origin and rotation vector in the arm's base frame.") + table(header, rows),
    )


def _parameter_row(estimate: Estimate) -> Sequence[Cell]:
    parameter = estimate.parameter
    unit, scale, form = UNITS.get(parameter.unit, (parameter.unit, 1.0, ".5g"))
    is_open = estimate.undetermined_share > NO_EFFECT
    sd = "" if math.isnan(estimate.sd) or is_open else f"{scale * estimate.sd:{form}}"
    bound = f"± {scale * parameter.bound:.4g}" if math.isfinite(parameter.bound) else "none"
    return (
        parameter.name,
        unit,
        f"{scale * parameter.nominal:{form}}" if parameter.has_bound else "unknown",
        ("after", f"{scale * estimate.value:z{form}}"),
        f"{scale * estimate.deviation:+z{form}}" if parameter.has_bound else "",
        sd,
        bound,
        ("text", _remark(estimate)),
    )


def _remark(estimate: Estimate) -> str:
    remarks = []
    if estimate.undetermined_share > NO_EFFECT:
        remarks.append("no effect, kept at nominal")
    elif not estimate.is_determined:
        remarks.append("moves together with others")
    if estimate.is_at_bound:
        remarks.append("at its bound")
    return ", ".join(remarks)


def dh_section(nominal: Arm, calibrated: Arm) -> Section:
    """DH parameters and tool before and after: SpringerPlus 5:1771, Table 5; or that their rows are not the same."""
    title = "DH parameters before and after"
    try:
        nominal, calibrated = in_the_same_rows(nominal, calibrated)
    except ArmError as problem:
        return Section(title, paragraph(f"{problem}."))
    rows: list[Sequence[Cell]] = []
    keys = (("d_m", "m"), ("theta_rad", "rad"), ("L_m", "m"), ("alpha_rad", "rad"))
    links = zip(nominal.links, calibrated.links, strict=True)
    for number, (before, after) in enumerate(links, start=1):
        was, now = ([getattr(link, key) for key, _ in keys] for link in (before, after))
        units = [unit for _, unit in keys]
        rows.append((f"link {number}", ("before", "original"), *_row_of(was, units)))
        rows.append(("", ("after", "calibrated"), *_row_of(now, units)))
        moved = [b - a for a, b in zip(was, now, strict=True)]
        rows.append(("", ("soft", "difference"), *_row_of(moved, units, "+")))
    header = ("", "", "d [mm]", "theta [deg]", "L [mm]", "alpha [deg]")
    tool = _tool(nominal, calibrated)
    return Section(title, table(header, rows) + (paragraph(tool) if tool else ""))


def _row_of(values: Sequence[float], units: Sequence[str], sign: str = "") -> list[str]:
    return [f"{UNITS[unit][1] * value:{sign}z{UNITS[unit][2]}}" for value, unit in zip(values, units, strict=True)]


def _tool(nominal: Arm, calibrated: Arm) -> str:
    before, after = nominal.tool.position_m, calibrated.tool.position_m
    if before == after:
        return ""
    was, now = (", ".join(f"{1e3 * part:.3f}" for part in place) for place in (before, after))
    return f"Tip in the last frame: {was} mm nominal, {now} mm calibrated."


SHOWN = 24  # most points listed unfolded
SUMMARY = ("mean [mm]", "95 % of the mean [mm]", "RMS [mm]", "max [mm]", "sd [mm]")


def verification_section(comparison: Comparison, where: str) -> Section:
    """Errors at points, described by `where`: SpringerPlus 5:1771, Table 4."""
    return Section(
        f"Error before and after, {where}",
        comparison_table(comparison)
        + bullets(findings(comparison))
        + vector_picture(comparison)
        + pair(histogram_picture(comparison), setup_picture(comparison))
        + _every_point(comparison),
    )


def calibration_section(comparison: Comparison) -> Section:
    """Errors at the points of the fit."""
    return Section(
        "At the calibration points",
        paragraph("The fit used these points, so their errors are biased low; judge by points not used.", "soft")
        + comparison_table(comparison)
        + vector_picture(comparison)
        + pair(histogram_picture(comparison), setup_picture(comparison)),
    )


def paths_section(pairs: Sequence[TrackPair]) -> Section:
    """Trajectories that calibration did not use: Table 6, Figs. 6, 7 and 10."""
    along = compare_tracks(pairs)
    figures = "".join(heading(f"{pair.name}, board {pair.setup}") + path_picture(pair) for pair in pairs)
    if along is None:
        return Section("Ideal and actual trajectories", paragraph("No path was run."))
    return Section(
        "Ideal and actual trajectories",
        comparison_table(along, "parts")
        + bullets(findings(along))
        + paragraph(
            f"Each path counts as {PARTS} parts, each with its mean error vector: errors of neighbouring camera frames are"
            " correlated and would make the interval too narrow.",
            "soft small",
        )
        + figures,
    )


def comparison_table(comparison: Comparison, counted: str = "points") -> str:
    """Each setup, and all: figures before and after, improvement."""
    rows: list[Sequence[Cell]] = []
    for entry in comparison.by_setup():
        rows.append((entry.setup, str(entry.before.count), ("before", "before"), *_figures(entry.before), ""))
        rows.append(("", "", ("after", "after"), *_figures(entry.after), f"{entry.improvement_percent:.1f} %"))
    return table(("setup", counted, "", *SUMMARY, "improved"), rows)


def _figures(summary: ErrorSummary) -> tuple[str, ...]:
    interval = "" if math.isnan(summary.mean_half_width_m) else f"± {1e3 * summary.mean_half_width_m:.3f}"
    spread = "" if math.isnan(summary.sd_m) else f"{1e3 * summary.sd_m:.3f}"
    return (f"{1e3 * summary.mean_m:.3f}", interval, f"{1e3 * summary.rms_m:.3f}", f"{1e3 * summary.max_m:.3f}", spread)


def _every_point(comparison: Comparison) -> str:
    """Every point with its own interval, folded if there are many."""
    rows: list[Sequence[Cell]] = []
    before, after = norms(comparison.before_m), norms(comparison.after_m)
    for k, (setup, point) in enumerate(zip(comparison.setup, comparison.point, strict=True)):
        x, y, z = (f"{1e3 * v:.1f}" for v in comparison.tip_m[k])
        rows.append(
            (
                setup,
                ("text", point),
                x,
                y,
                z,
                ("before", _with_interval(before[k], comparison.before_half_width_m[k])),
                ("after", _with_interval(after[k], comparison.after_half_width_m[k])),
                f"{improvement_percent(before[k], after[k]):.1f} %",
            )
        )
    header = ("setup", ("text", "point"), "x [mm]", "y [mm]", "z [mm]", "before [mm]", "after [mm]", "improved")
    has_repeats = bool(np.isfinite(comparison.after_half_width_m).any())
    title = f"all {len(rows)} points{' (± is 95 % from the repeats at the point)' if has_repeats else ''}"
    return folded(title, table(header, rows), is_open=len(rows) <= SHOWN)


def _with_interval(distance_m: float, half_width_m: float) -> str:
    if math.isnan(half_width_m):
        return f"{1e3 * distance_m:.3f}"
    digits = max(3, digits_mm(half_width_m))
    return f"{1e3 * distance_m:.{digits}f} ± {1e3 * half_width_m:.{digits}f}"


UNUSED = "at points that calibration did not use"


@dataclass(frozen=True, slots=True)
class ReportData:
    """The contents of report.html. Absent parts are omitted.

    `verdict`: sentences at the top. `paths`: trajectories by the nominal and the calibrated model. `arms`: nominal
    and calibrated, for the table of their DH parameters. `sections`: more of them, after the comparisons. `verified_at`: where
    the verification was.
    """

    title: str
    arm: str
    made: Provenance
    steps: tuple[str, ...]
    paths: tuple[TrackPair, ...] = ()
    identification: Identification | None = None
    calibration: Comparison | None = None
    verification: Comparison | None = None
    arms: tuple[Arm, Arm] | None = None
    notes: tuple[str, ...] = ()
    verdict: tuple[str, ...] = ()
    sections: tuple[Section, ...] = ()
    verified_at: str = UNUSED
    held: HeldOut | None = None  # what a calibration gives for points that it does not use


def write_report(path: Path, report: ReportData) -> None:
    """Write report.html, creating its folder if necessary."""
    write_whole(path, report_html(report))


def report_html(report: ReportData) -> str:
    """The whole page."""
    return page(report.title, report.arm, report.made.line, _parts(report))


def _parts(report: ReportData) -> Iterator[Section | str]:
    if report.verdict:
        yield verdict(report.verdict)
    yield tiles(_results(report))
    yield done_section(report.steps, report.notes)
    if report.verification is not None:
        yield verification_section(report.verification, report.verified_at)
    if report.paths:
        yield paths_section(report.paths)
    yield from report.sections
    if report.arms is not None:
        yield dh_section(*report.arms)
    if report.identification is not None:
        yield parameters_section(report.identification)
    if report.calibration is not None:
        yield calibration_section(report.calibration)
    if report.made.inputs:
        yield inputs_section(report.made.inputs)


def _results(report: ReportData) -> Iterator[tuple[str, str, str]]:
    """The result in a few figures."""
    judged, held = report.verification or report.calibration, report.held
    if held is not None:
        what = "scatter" if held.is_scatter else "error"
        where = "at points that were left out of the fit"
        yield "before", f"{1e3 * float(held.before_m.mean()):.2f} mm", f"mean {what} before, {where}"
        yield "after", f"{1e3 * float(held.after_m.mean()):.2f} mm", f"mean {what} after, {where}"
        yield "", f"{held.improvement_percent:.1f} %", f"smaller mean {what}, {where}"
    elif judged is not None:
        entry = judged.of("all")
        where = report.verified_at if report.verification is not None else "at the points of the fit itself"
        yield "before", f"{1e3 * entry.before.mean_m:.2f} mm", f"mean error before, {where}"
        yield "after", f"{1e3 * entry.after.mean_m:.2f} mm", f"mean error after, {where}"
        yield "", f"{entry.improvement_percent:.1f} %", f"smaller mean error, {where}"
    fit = report.identification
    if fit is not None:
        yield "", f"{fit.rank} of {len(fit.estimates)}", "parameters that the points determine"


# A verification as a whole: comparison, trajectories, verdict; as verify.json and report.html (docs/verify.md).


FORMAT = "verify/1"


@dataclass(frozen=True, slots=True)
class Verification:
    """A comparison and its circumstances. `how` and `warnings` are sentences; `is_driven`: the arm moved to the points.

    `used_count`: of its `pose_count` poses, those that the calibration used already.
    """

    nominal: Arm
    calibrated: Arm
    comparison: Comparison
    paths: tuple[TrackPair, ...]
    how: tuple[str, ...]
    warnings: tuple[str, ...]
    is_driven: bool
    made: Provenance
    used_count: int = 0
    pose_count: int = 0
    turns: TurnComparison | None = None

    @property
    def verifies_nothing(self) -> bool:
        """Whether every pose was used for the calibration."""
        return 0 < self.pose_count <= self.used_count

    @property
    def is_worse(self) -> bool:
        """Whether the calibrated arm is significantly worse than the nominal one over all points."""
        return self.comparison.of(ALL).difference.finding is PairedFinding.WORSE

    @property
    def verdict(self) -> tuple[str, ...]:
        """The result at the points and along the trajectories."""
        entry = self.comparison.of(ALL)
        before, after = (1e3 * summary.mean_m for summary in (entry.before, entry.after))
        sentences = []
        if self.used_count:
            sentences.append(
                f"NOT VERIFIED: {self.used_count} of the {self.pose_count} poses were used for the calibration, and an arm fits"
                " the points of its own fit: verify at others."
            )
        sentences += [
            f"The calibrated arm is {_spelled(entry.difference)} over {entry.after.count} points:"
            f" {before:.2f} mm before, {after:.2f} mm after ({entry.improvement_percent:+.1f} %)."
        ]
        sentences += [f"Board {one.setup}: worse, although the total is not." for one in self._worse_alone()]
        if self.turns is not None:
            sentences.append(self.turns.in_words())
        along = compare_tracks(self.paths)
        if along is not None:
            sentences.append(f"Along trajectories: {along.of(ALL).difference.in_words()}.")
        return tuple(sentences)

    def _worse_alone(self) -> list[SetupComparison]:
        if self.is_worse:
            return []
        return [one for one in self.comparison.by_setup() if one.difference.finding is PairedFinding.WORSE]


def _spelled(difference: Difference) -> str:
    if difference.finding is PairedFinding.NOTHING:
        return f"neither better nor worse ({difference.in_words()})"
    return difference.in_words()


def write_verification_report(path: Path, verification: Verification) -> None:
    """report.html."""
    of = verification.calibrated
    write_report(
        path,
        ReportData(
            title="Verification of a calibrated arm",
            arm=of.name,
            made=verification.made,
            steps=verification.how,
            paths=verification.paths,
            verification=verification.comparison,
            arms=(verification.nominal, of),
            notes=verification.warnings,
            verdict=verification.verdict,
            verified_at=UNUSED if verification.used_count == 0 else "at the points given",
        ),
    )


def write_verification_json(path: Path, verification: Verification) -> None:
    """Write verify.json."""
    compared, along = verification.comparison, compare_tracks(verification.paths)
    heading = verification.made.heading(FORMAT, arm=verification.calibrated.name)
    content = {
        "driven": verification.is_driven,
        "verdict": {
            "finding": compared.of(ALL).difference.finding.name.lower(),
            "is_worse": verification.is_worse,
            "used_poses": verification.used_count,
            "in_words": verification.verdict,
            "by_setup": findings(compared),
        },
        "warnings": verification.warnings,
        "by_setup": comparison_figures(compared),
        "points": _points(compared),
        "orientation": None if verification.turns is None else verification.turns.as_dict(),
        "trajectories": None if along is None else {"by_setup": comparison_figures(along), "parts": _points(along)},
        "dh": {"before": verification.nominal.dh, "after": verification.calibrated.dh},
        "tool_m": {"before": verification.nominal.tool.position_m, "after": verification.calibrated.tool.position_m},
    }
    write_json(path, heading | content)


def comparison_figures(comparison: Comparison) -> dict[str, object]:
    """Figures of each setup, and of all."""
    return {
        entry.setup: entries(entry, "before", "after", "improvement_percent")
        | {
            "difference": entries(entry.difference, "mean_m", "lower_m", "upper_m")
            | {"finding": entry.difference.finding.name.lower()}
        }
        for entry in comparison.by_setup()
    }


def _points(comparison: Comparison) -> list[dict[str, object]]:
    return [
        {
            "setup": comparison.setup[k],
            "point": comparison.point[k],
            "tip_m": comparison.tip_m[k],
            "before": _point(comparison.before_m[k], comparison.before_half_width_m[k]),
            "after": _point(comparison.after_m[k], comparison.after_half_width_m[k]),
        }
        for k in range(len(comparison.point))
    ]


def _point(error_m: Array, half_width_m: float) -> dict[str, object]:
    return {"error_m": error_m, "distance_m": np.linalg.norm(error_m), "half_width_m": half_width_m}
