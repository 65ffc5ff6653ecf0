"""The study's result in sentences and as text."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.arm_problem.parameters import ANGLE_BOUND_rad, LENGTH_BOUND_m
from calib.studies.figures import Figure
from calib.tolerances.making import MadeArms
from calib.tolerances.result import Made, costliest
from calib.tolerances.study import STAGES, Design

LISTED = 8
SAMPLE = 4000  # arms drawn for the check of bounds
BEYOND = 0.01  # of the arms beyond a bound, from which it is said


def sentences(made: Made, tolerance_m: float | None) -> tuple[str, ...]:
    """What the study says, the most useful first."""
    return tuple(_sentences(made, tolerance_m))


def _sentences(made: Made, tolerance_m: float | None) -> Iterator[str]:
    yield (
        f"{made.arms_count} arms {made.design.arm.name} were drawn. As built, half of them keep {_mm(made.kept(0, 0.5))} and"
        f" 95 % of them {_mm(made.kept(0, 0.95))} at 95 % of their poses."
    )
    yield (
        f"Calibrated with {len(made.design.calibration)} poses, half keep {_mm(made.kept(1, 0.5))} and 95 %"
        f" {_mm(made.kept(1, 0.95))}; with their effects corrected as well, {_mm(made.kept(2, 0.5))} and"
        f" {_mm(made.kept(2, 0.95))}."
    )
    if tolerance_m is not None:
        shares = [made.within(stage, tolerance_m) for stage in range(len(STAGES))]
        said = ", ".join(f"{_percent(share)} {name}" for name, share in zip(STAGES, shares, strict=True))
        yield f"{1e3 * tolerance_m:.3g} mm are kept by: {said}."
    for stage, name in enumerate(STAGES):
        first = costliest(made, stage)[0]
        yield (
            f"What costs most {name}: {first.name}. If it were exact, {1e3 * first.left_m[stage]:.3g} of"
            f" {1e3 * made.rms_m(stage):.3g} mm would be left (root mean square)."
        )


def warnings_about(design: Design) -> list[str]:
    """What the real commands could not do as the study does it."""
    made = MadeArms(design.arm, design.tolerances)
    geometry = 4 * len(design.arm.links)
    off = np.abs(made.drawn(np.random.default_rng(1), SAMPLE)[:, :geometry])
    bounds = np.tile([LENGTH_BOUND_m, ANGLE_BOUND_rad], geometry // 2)
    found = []
    if float(np.mean((off > bounds).any(axis=1))) > BEYOND:
        found.append(
            "some arms deviate by more than calibrate's bounds of 5 mm and 2 deg, which the study does not enforce: give"
            " `armwright calibrate` wider ones"
        )
    unknowns = geometry + len(made.correctable)
    if 3 * len(design.calibration) < 2 * unknowns:
        found.append(
            f"{len(design.calibration)} poses are few for {unknowns} parameters: the arms differ by chance in what is left"
        )
    return found


def stage_rows(made: Made, tolerance_m: float | None) -> list[tuple[str, ...]]:
    """For each stage: what half and 95 % of the arms keep, the root mean square, and the share within the tolerance."""
    rows = []
    for stage, name in enumerate(STAGES):
        kept = (_mm(made.kept(stage, 0.5)), _mm(made.kept(stage, 0.95)), f"{1e3 * made.rms_m(stage):.3g} mm")
        share = () if tolerance_m is None else (_percent(made.within(stage, tolerance_m)),)
        rows.append((name, *kept, *share))
    return rows


def stage_heading(tolerance_m: float | None) -> tuple[str, ...]:
    """The columns of `stage_rows`."""
    share = () if tolerance_m is None else (f"arms that keep {1e3 * tolerance_m:.3g} mm",)
    return ("", "half of the arms keep", "95 % of the arms keep", "root mean square", *share)


def cost_rows(made: Made, stage: int) -> list[tuple[str, str, str]]:
    """The costliest tolerances: name, share of the mean square error, what is left if it is exact [mm]."""
    return [
        (one.name, _percent(one.share[stage]), f"{1e3 * one.left_m[stage]:.3f}")
        for one in costliest(made, stage)[:LISTED]
    ]


def as_text(made: Made, tolerance_m: float | None) -> str:
    """What the command prints."""
    lines = list(sentences(made, tolerance_m))
    for stage, name in enumerate(STAGES):
        lines += ["", f"  {f'{name}: if this were exact':<40}{'error less by':>26}{'left [mm]':>12}"]
        lines += [f"  {what:<40}{share:>26}{left:>12}" for what, share, left in cost_rows(made, stage)]
    return "\n".join(lines) + "\n"


def _mm(one: Figure) -> str:
    return f"{1e3 * one.value:.3g} mm ({1e3 * one.lower:.3g} to {1e3 * one.upper:.3g})"


def _percent(one: Figure) -> str:
    return f"{100 * one.value:.1f} % ({100 * one.lower:.1f} to {100 * one.upper:.1f})"
