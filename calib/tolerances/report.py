"""The page of the tolerance study."""

from __future__ import annotations

from collections.abc import Sequence

from calib.report.page import Section, bullets, page, pair, paragraph, table, verdict
from calib.tolerances.pictures import costs_picture, map_picture, shares_picture
from calib.tolerances.result import Made
from calib.tolerances.study import COST_ARMS, STAGES
from calib.tolerances.words import cost_rows, sentences, stage_heading, stage_rows

ABOUT = (
    "As built: the arm's file is nominal. Calibrated: geometry identified from the calibration's poses. Corrected: backlash,"
    " stiffness, bending, scale and eccentricity identified too, as far as they have a tolerance: the best that `gap` can do."
)
COSTS = (
    "By how much the mean square error falls if one tolerance is exact and the others are as they are"
    f" ({COST_ARMS} arms, 95 % intervals). Shares add up to more than 100 % where errors add up in one direction."
)


def tolerances_report(
    made: Made, tolerance_m: float | None, warnings: Sequence[str], date: str, program_version: str
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
    return page("Arms made to these tolerances", made.design.arm.name, f"{date} · {program_version}", parts)
