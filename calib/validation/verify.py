"""Before and after, on points that calibration did not use: SpringerPlus 5:1771, Tables 4 and 6."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, frozen, norms
from calib.errors import CalibrationError
from calib.validation.statistics import Difference, ErrorSummary, difference, mean_half_width, summarise

__all__ = [
    "ALL",
    "Comparison",
    "ErrorSummary",
    "SetupComparison",
    "aligned",
    "compare",
    "compare_repeated",
    "comparison_text",
    "findings",
    "improvement_percent",
    "summarise",
]

ALL = "all"


@dataclass(frozen=True, slots=True)
class SetupComparison:
    """One setup (or `all`): errors before and after, and the improvement of the mean."""

    setup: str
    before: ErrorSummary
    after: ErrorSummary
    difference: Difference

    @property
    def improvement_percent(self) -> float:
        """100 (before - after) / before of the means; negative if worse, 0 if there was no error."""
        return improvement_percent(self.before.mean_m, self.after.mean_m)


@dataclass(frozen=True, slots=True)
class Comparison:
    """Points with their error vectors (measured minus target, base frame) before and after calibration.

    setup, point: m names; tip_m, before_m, after_m: (m, 3). Half widths (m,): of the 95 % interval of each point's
    distance, from repeats at the point; NaN without repeats. `cautions`: sentences about the points.
    """

    setup: tuple[str, ...]
    point: tuple[str, ...]
    tip_m: Array
    before_m: Array
    after_m: Array
    before_half_width_m: Array
    after_half_width_m: Array
    cautions: tuple[str, ...] = ()

    @property
    def setups(self) -> tuple[str, ...]:
        """Names of the setups in the order of their first point."""
        return tuple(dict.fromkeys(self.setup))

    def thinned(self, count: int) -> Comparison:
        """At most `count` points, spread evenly over all."""
        if len(self.setup) <= count:
            return self
        rows = np.linspace(0, len(self.setup) - 1, count).astype(np.intp)
        return Comparison(
            tuple(self.setup[k] for k in rows.tolist()),
            tuple(self.point[k] for k in rows.tolist()),
            frozen(self.tip_m[rows]),
            frozen(self.before_m[rows]),
            frozen(self.after_m[rows]),
            frozen(self.before_half_width_m[rows]),
            frozen(self.after_half_width_m[rows]),
            self.cautions,
        )

    def of(self, setup: str) -> SetupComparison:
        """One setup, or `all` for every point."""
        rows = [k for k, name in enumerate(self.setup) if setup in (name, ALL)]
        before_m, after_m = norms(self.before_m[rows]), norms(self.after_m[rows])
        return SetupComparison(setup, summarise(before_m), summarise(after_m), difference(before_m, after_m))

    def by_setup(self) -> tuple[SetupComparison, ...]:
        """Each setup, then all points together if there are several setups."""
        names = self.setups if len(self.setups) == 1 else (*self.setups, ALL)
        return tuple(self.of(name) for name in names)


def improvement_percent(before_m: float, after_m: float) -> float:
    """100 (before - after) / before; 0 where there was no error before."""
    return 100.0 * (1.0 - after_m / before_m) if before_m > 0.0 else 0.0


def compare(
    setup: Sequence[str],
    point: Sequence[str],
    tip_m: Array,
    before_m: Array,
    after_m: Array,
    before_half_width_m: Array | None = None,
    after_half_width_m: Array | None = None,
) -> Comparison:
    """Compare errors; CalibrationError if the arrays do not match or are not finite."""
    shapes = {np.shape(tip_m), np.shape(before_m), np.shape(after_m), (len(setup), 3), (len(point), 3)}
    if len(shapes) != 1 or not len(setup):
        raise CalibrationError(
            f"names, tips and errors: expected equal shapes and at least one point, got {sorted(shapes)}"
        )
    if not all(np.isfinite(values).all() for values in (tip_m, before_m, after_m)):
        raise CalibrationError(
            "a tip or an error is not a finite number: remove points that were not measured"
        )
    unknown = np.full(len(setup), np.nan)
    return Comparison(
        tuple(setup),
        tuple(point),
        frozen(tip_m),
        frozen(before_m),
        frozen(after_m),
        frozen(unknown if before_half_width_m is None else before_half_width_m),
        frozen(unknown if after_half_width_m is None else after_half_width_m),
    )


def compare_repeated(
    setup: Sequence[str], point: Sequence[str], tip_m: Array, before_m: Array, after_m: Array
) -> Comparison:
    """As `compare`, with several rows per point: its error is the mean vector of its repeats.

    The interval of a point's distance is that of the repeats' parts along the mean error: t s / sqrt(k).
    """
    rows: dict[tuple[str, str], list[int]] = {}
    for row, name in enumerate(zip(setup, point, strict=True)):
        rows.setdefault(name, []).append(row)
    before = [_of_repeats(before_m[k]) for k in rows.values()]
    after = [_of_repeats(after_m[k]) for k in rows.values()]
    return compare(
        [name for name, _ in rows],
        [name for _, name in rows],
        np.array([tip_m[k].mean(axis=0) for k in rows.values()]),
        np.array([mean for mean, _ in before]),
        np.array([mean for mean, _ in after]),
        np.array([half for _, half in before]),
        np.array([half for _, half in after]),
    )


def _of_repeats(errors_m: Array) -> tuple[Array, float]:
    """Mean of error vectors (k, 3), and half the 95 % interval of its length."""
    mean = errors_m.mean(axis=0)
    length = float(np.linalg.norm(mean))
    return mean, mean_half_width(errors_m @ (mean / length)) if length > 0.0 else math.nan


def comparison_text(comparison: Comparison) -> str:
    """The comparison as a table of plain text, in mm."""
    rows: list[tuple[str, ...]] = [
        ("setup", "points", "", "mean [mm]", "95 % interval", "RMS", "max", "sd", "improvement")
    ]
    for entry in comparison.by_setup():
        rows.append((entry.setup, str(entry.before.count), "before", *_figures(entry.before), ""))
        rows.append(("", "", "after", *_figures(entry.after), f"{entry.improvement_percent:.1f} %"))
    return aligned(rows)


def _figures(summary: ErrorSummary) -> tuple[str, ...]:
    """Mean, interval, RMS, largest, standard deviation, in mm."""
    low, high = summary.mean_m - summary.mean_half_width_m, summary.mean_m + summary.mean_half_width_m
    return (
        f"{1e3 * summary.mean_m:.3f}",
        f"{1e3 * low:.3f} to {1e3 * high:.3f}" if math.isfinite(low) else "unknown",
        f"{1e3 * summary.rms_m:.3f}",
        f"{1e3 * summary.max_m:.3f}",
        f"{1e3 * summary.sd_m:.3f}",
    )


def findings(comparison: Comparison) -> tuple[str, ...]:
    """Significance of the difference for each setup, and for all together."""
    return tuple(f"{entry.setup}: {entry.difference.in_words()}" for entry in comparison.by_setup())


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
