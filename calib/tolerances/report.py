"""The page of the tolerance study, and its pictures: how many arms keep what, where errors are large, what
costs what.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.report.drawing import AFTER, BEFORE, PLANNED, svg
from calib.report.page import Section, bullets, page, pair, paragraph, table, verdict
from calib.results import Provenance
from calib.tolerances.result import Made, cost_rows, costliest, sentences, stage_heading, stage_rows
from calib.tolerances.study import COST_ARMS, STAGES

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Pictures of the study: how many arms keep what, where errors are large, and what costs most.


STYLES = ((BEFORE, "--"), (AFTER, "-."), ("#009E73", "-"))
BARS = 9
COLOURS = "viridis"


def shares_picture(made: Made, tolerance_m: float | None) -> str:
    """The share of the arms that keep a distance, a curve for each stage."""
    return svg((5.6, 3.6), lambda figure: _draw_shares(figure, made, tolerance_m))


def map_picture(made: Made) -> str:
    """From the side, for each stage: the distance that 95 % of the arms keep at each pose."""
    return svg((10.4, 3.6), lambda figure: _draw_maps(figure, made))


def costs_picture(made: Made) -> str:
    """For each stage, the tolerances that cost most, with intervals."""
    return svg((10.4, 3.4), lambda figure: _draw_costs(figure, made))


def _draw_shares(figure: Figure, made: Made, tolerance_m: float | None) -> None:
    from matplotlib.ticker import LogLocator

    figure.subplots_adjust(left=0.12, right=0.97, top=0.95, bottom=0.15)
    axes = figure.subplots()
    percent = 100.0 * np.arange(1, made.arms_count + 1) / made.arms_count
    for kept, name, (colour, line) in zip(made.kept_m, STAGES, STYLES, strict=True):
        axes.plot(1e3 * np.sort(kept), percent, line, color=colour, label=name)
    if tolerance_m is not None:
        axes.axvline(1e3 * tolerance_m, color=PLANNED, linewidth=1.0)
    axes.set(xlabel="kept at 95 % of an arm's poses [mm]", ylabel="share of the arms [%]", ylim=(0, 100))
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.legend(loc="lower right")


def _draw_maps(figure: Figure, made: Made) -> None:
    figure.subplots_adjust(left=0.06, right=0.97, top=0.9, bottom=0.15, wspace=0.45)
    arm = made.design.arm
    tips_mm = 1e3 * ArmModel(arm).tips(arm.dh, made.design.map.q_rad)
    away_mm = np.hypot(tips_mm[:, 0], tips_mm[:, 1])
    for stage, axes in enumerate(figure.subplots(1, len(STAGES))):
        kept_mm = 1e3 * made.map_m(stage)
        seen = axes.scatter(
            away_mm,
            tips_mm[:, 2],
            c=kept_mm,
            cmap=COLOURS,
            vmin=0.0,
            vmax=float(np.quantile(kept_mm, 0.98)),
            s=12,
        )
        axes.set(xlabel="distance from the axis of the base [mm]", ylabel="z [mm]", aspect="equal")
        axes.set_title(STAGES[stage], loc="left")
        figure.colorbar(seen, ax=axes, shrink=0.9).set_label("95 % of the arms keep [mm]")


def _draw_costs(figure: Figure, made: Made) -> None:
    figure.subplots_adjust(left=0.15, right=0.98, top=0.9, bottom=0.15, wspace=1.0)
    for stage, axes in enumerate(figure.subplots(1, len(STAGES))):
        first = costliest(made, stage)[:BARS][::-1]
        shares = np.array(
            [[one.share[stage].value, one.share[stage].lower, one.share[stage].upper] for one in first]
        )
        spread = 100 * np.abs(shares[:, 1:] - shares[:, :1]).T
        axes.barh(
            [one.name for one in first], 100 * shares[:, 0], xerr=spread, color=STYLES[stage][0], height=0.6,
            error_kw={"elinewidth": 0.8},
        )  # fmt: skip
        axes.set(xlabel="mean square error less if exact [%]")
        axes.set_title(STAGES[stage], loc="left")
        axes.grid(visible=False, axis="y")


# The page of the tolerance study.


ABOUT = (
    "As built: the arm's file is nominal. Calibrated: geometry identified from the calibration's poses. Corrected: backlash,"
    " stiffness, bending, scale and eccentricity identified too, as far as they have a tolerance: the best that `gap` can do."
)
COSTS = (
    "By how much the mean square error falls if one tolerance is exact and the others are as they are"
    f" ({COST_ARMS} arms, 95 % intervals). Shares add up to more than 100 % where errors add up in one direction."
)


def tolerances_report(
    made: Made, tolerance_m: float | None, warnings: Sequence[str], provenance: Provenance
) -> str:
    """The page."""
    head = ("tolerance", "error less by", "left [mm]")
    costs = [f"<h3>{name}</h3>{table(head, cost_rows(made, stage))}" for stage, name in enumerate(STAGES)]
    stages = table(stage_heading(tolerance_m), stage_rows(made, tolerance_m))
    parts: list[Section | str] = [
        verdict(sentences(made, tolerance_m)),
        Section("How accurate the arms are", paragraph(ABOUT) + stages + shares_picture(made, tolerance_m)),
        Section("Over the workspace", map_picture(made)),
        Section(
            "What costs most", paragraph(COSTS) + costs_picture(made) + pair(costs[0], costs[1]) + costs[2]
        ),
    ]
    if warnings:
        parts.append(Section("Warnings", bullets(warnings)))
    return page("Arms made to these tolerances", made.design.arm.name, provenance.line, parts)
