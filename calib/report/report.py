"""report.html: procedure and results in one file without outside resources.

`report_html` has the sections in their usual order. `report_sections` has single sections;
`page.page` makes a page of any sections.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arrays import Array
from calib.identify.identification import Identification
from calib.report.page import Section, page, tiles, verdict
from calib.report.report_sections import (
    calibration_section,
    dh_section,
    done_section,
    inputs_section,
    parameters_section,
    paths_section,
    verification_section,
)
from calib.results import Provenance, entries, write_json
from calib.validation.holdout import HeldOut
from calib.validation.statistics import Difference, PairedFinding
from calib.validation.verify import (
    ALL,
    Comparison,
    SetupComparison,
    TrackPair,
    TurnComparison,
    compare_tracks,
    findings,
)
from control.files import write_whole
from control.model.arm import Arm

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
    found = report.identification
    if found is not None:
        yield "", f"{found.rank} of {len(found.estimates)}", "parameters that the points determine"


# A verification as a whole: comparison, trajectories, verdict; as verify.json and report.html (docs/verify.md).


FORMAT = "verify/1"


@dataclass(frozen=True, slots=True)
class Verification:
    """A comparison and its circumstances. `how` and `warnings` are sentences; `is_driven`: the arm moved to the points.

    `used_count`: poses already used by the calibration.
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
    turns: TurnComparison | None = None

    @property
    def verifies_nothing(self) -> bool:
        """Whether every pose was used for the calibration."""
        return self.used_count >= self.comparison.of(ALL).after.count

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
                f"NOT VERIFIED: {self.used_count} of the {entry.after.count} poses were used for the calibration, and an arm fits"
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
        "trajectories": None
        if along is None
        else {"by_setup": comparison_figures(along), "parts": _points(along)},
        "dh": {"before": verification.nominal.dh, "after": verification.calibrated.dh},
        "tool_m": {
            "before": verification.nominal.tool.position_m,
            "after": verification.calibrated.tool.position_m,
        },
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
