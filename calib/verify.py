"""Before and after, on points that calibration did not use: SpringerPlus 5:1771, Tables 4 and 6."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, frozen, norms
from calib.errors import CalibrationError
from calib.identify.arm_model import ArmModel
from calib.points import Points

CONFIDENCE = 0.95
ALL = "all"


@dataclass(frozen=True, slots=True)
class ErrorSummary:
    """Distances between wanted and measured tips: how many, mean, root mean square, largest, standard
    deviation.

    `mean_half_width_m` is half the 95 % confidence interval of the mean (Student's t); NaN for fewer than two
    points.
    """

    count: int
    mean_m: float
    rms_m: float
    max_m: float
    sd_m: float
    mean_half_width_m: float


@dataclass(frozen=True, slots=True)
class SetupComparison:
    """One setup (or `all`): errors before and after, and how much smaller the mean became."""

    setup: str
    before: ErrorSummary
    after: ErrorSummary

    @property
    def improvement_percent(self) -> float:
        """100 (before - after) / before of the means; negative if worse, 0 if there was no error."""
        return 100.0 * (1.0 - self.after.mean_m / self.before.mean_m) if self.before.mean_m > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class Comparison:
    """Points with their error vectors (measured minus wanted, base frame) before and after calibration.

    setup, point: m names; tip_m, before_m, after_m: (m, 3).
    """

    setup: tuple[str, ...]
    point: tuple[str, ...]
    tip_m: Array
    before_m: Array
    after_m: Array

    @property
    def setups(self) -> tuple[str, ...]:
        """Names of the setups in the order of their first point."""
        return tuple(dict.fromkeys(self.setup))

    def of(self, setup: str) -> SetupComparison:
        """One setup, or `all` for every point."""
        rows = [k for k, name in enumerate(self.setup) if setup in (name, ALL)]
        return SetupComparison(
            setup, summarise(norms(self.before_m[rows])), summarise(norms(self.after_m[rows]))
        )

    def by_setup(self) -> tuple[SetupComparison, ...]:
        """Each setup, then all points together if there are several setups."""
        names = self.setups if len(self.setups) == 1 else (*self.setups, ALL)
        return tuple(self.of(name) for name in names)


def compare(
    setup: Sequence[str], point: Sequence[str], tip_m: Array, before_m: Array, after_m: Array
) -> Comparison:
    """A Comparison; CalibrationError where the arrays do not belong together or hold no numbers."""
    shapes = {np.shape(tip_m), np.shape(before_m), np.shape(after_m), (len(setup), 3), (len(point), 3)}
    if len(shapes) != 1 or not len(setup):
        raise CalibrationError(f"names, tips and errors of different shape, or none at all: {sorted(shapes)}")
    if not all(np.isfinite(values).all() for values in (tip_m, before_m, after_m)):
        raise CalibrationError(
            "a tip or an error is not a finite number: leave points out that were not measured"
        )
    return Comparison(tuple(setup), tuple(point), frozen(tip_m), frozen(before_m), frozen(after_m))


def compare_points(model: ArmModel, nominal_dh: Array, dh: Array, points: Points) -> Comparison:
    """Measured tips against those that the DH table predicts from the encoders, before and after calibration.

    Points without a measured tip are left out.
    """
    seen = points.chosen(np.flatnonzero(np.isfinite(points.tip_m).all(axis=1)))
    before_m, after_m = (seen.tip_m - model.tips(np.asarray(table), seen.q_rad) for table in (nominal_dh, dh))
    return compare(seen.setup, seen.point, seen.tip_m, before_m, after_m)


def summarise(errors_m: Array) -> ErrorSummary:
    """Figures of distances (m,)."""
    m = len(errors_m)
    sd_m = float(np.std(errors_m, ddof=1)) if m > 1 else float("nan")
    return ErrorSummary(
        count=m,
        mean_m=float(np.mean(errors_m)),
        rms_m=float(np.sqrt(np.mean(errors_m**2))),
        max_m=float(np.max(errors_m)),
        sd_m=sd_m,
        mean_half_width_m=_student_t(m - 1) * sd_m / float(np.sqrt(m)) if m > 1 else float("nan"),
    )


def _student_t(freedom: int) -> float:
    """Two-sided 95 % quantile of Student's t."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.5 + 0.5 * CONFIDENCE))


def comparison_text(comparison: Comparison) -> str:
    """The comparison as a table of plain text, in mm."""
    rows: list[tuple[str, ...]] = [
        ("setup", "points", "", "mean [mm]", "95 % interval", "RMS", "max", "sd", "improvement")
    ]
    for entry in comparison.by_setup():
        rows.append((entry.setup, str(entry.before.count), "before", *_figures(entry.before), ""))
        rows.append(("", "", "after", *_figures(entry.after), f"{entry.improvement_percent:.1f} %"))
    return aligned(rows)


def points_text(comparison: Comparison) -> str:
    """Error before and after at every point, in mm."""
    before, after = norms(comparison.before_m), norms(comparison.after_m)
    rows = [("setup", "point", "before [mm]", "after [mm]")]
    rows += [
        (setup, point, f"{1e3 * b:.3f}", f"{1e3 * a:.3f}")
        for setup, point, b, a in zip(comparison.setup, comparison.point, before, after, strict=True)
    ]
    return aligned(rows)


def _figures(summary: ErrorSummary) -> tuple[str, ...]:
    """Mean, interval, RMS, largest, standard deviation, in mm."""
    low, high = summary.mean_m - summary.mean_half_width_m, summary.mean_m + summary.mean_half_width_m
    return (
        f"{1e3 * summary.mean_m:.3f}",
        f"{1e3 * low:.3f} to {1e3 * high:.3f}",
        f"{1e3 * summary.rms_m:.3f}",
        f"{1e3 * summary.max_m:.3f}",
        f"{1e3 * summary.sd_m:.3f}",
    )


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as columns: the first left-aligned, the others right-aligned."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join(
        "  ".join(
            cell.ljust(w) if k == 0 else cell.rjust(w)
            for k, (cell, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    )
