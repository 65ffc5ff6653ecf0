"""report.html of an error map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from calib.arrays import Array
from calib.report.drawing import AFTER, PLANNED, svg
from calib.report.page import Section, bullets, page, pair, paragraph, table, verdict
from calib.trust.iso9283 import PoseFigures, pose_rows
from calib.trust.task import Reliability
from calib.trust.trust import Trust
from calib.trust.words import POSE_HEAD, cause_rows, sentences, task_sentences

if TYPE_CHECKING:
    from matplotlib.figure import Figure


ABOUT = (
    "Colours: the distance from where the arm's file puts the tip that one visit keeps in 95 % of cases, from either direction"
    " of approach. It counts what is expected and not corrected, what the points do not determine, and what scatters."
)


def trust_report(
    trust: Trust,
    tasks: Sequence[Reliability],
    poses: Sequence[PoseFigures],
    date: str,
    program_version: str,
) -> str:
    """The page."""
    parts: list[Section | str] = [verdict(sentences(trust))]
    if tasks:
        parts.append(Section("Tasks", bullets(line for one in tasks for line in task_sentences(one))))
    if poses:
        parts.append(Section("ISO 9283: pose accuracy and repeatability", table(POSE_HEAD, pose_rows(poses))))
    parts += [
        Section("The error over the workspace", paragraph(ABOUT) + map_picture(trust)),
        Section("In space, and by payload", pair(space_picture(trust), payload_picture(trust))),
        Section(
            "What costs most",
            table(("if this were known exactly", "left [mm]", "expected [mm]"), cause_rows(trust))
            + causes_picture(trust),
        ),
    ]
    if trust.warnings:
        parts.append(Section("Warnings", bullets(trust.warnings)))
    return page("How far the arm can be trusted", trust.arm.name, f"{date} · {program_version}", parts)


# Pictures of the error map: from above and from the side, in space, by payload, and what costs most.

COLOURS = "viridis"
DASHES = ("-", "--", ":", "-.")
CAUSES = 10


def map_picture(trust: Trust) -> str:
    """The distance kept in 95 % of visits: tips from above (x, y) and from the side (radius, z)."""
    return svg((10.4, 4.4), lambda figure: _draw_map(figure, trust))


def space_picture(trust: Trust) -> str:
    """The same in space."""
    return svg((5.6, 4.6), lambda figure: _draw_space(figure, trust))


def payload_picture(trust: Trust) -> str:
    """The share of the workspace that keeps a distance, a curve for each payload."""
    return svg((5.1, 3.6), lambda figure: _draw_shares(figure, trust))


def causes_picture(trust: Trust) -> str:
    """What is left uncertain if one cause were known exactly."""
    return svg((5.1, 3.6), lambda figure: _draw_causes(figure, trust))


def _scale(trust: Trust) -> tuple[Array, dict[str, Any]]:
    reach_mm = 1e3 * trust.within_95_m
    top = float(np.quantile(reach_mm, 0.98))
    return reach_mm, {"c": reach_mm, "cmap": COLOURS, "vmin": 0.0, "vmax": top, "s": 9, "linewidths": 0.0}


def _draw_map(figure: Figure, trust: Trust) -> None:
    above, side = figure.subplots(1, 2)
    figure.subplots_adjust(left=0.07, right=0.98, top=0.9, bottom=0.13, wspace=0.2)
    _, style = _scale(trust)
    tips_mm = 1e3 * trust.sheets[0].error.tip_m
    above.scatter(tips_mm[:, 0], tips_mm[:, 1], **style)
    above.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    above.set_title("from above", loc="left")
    seen = side.scatter(np.hypot(tips_mm[:, 0], tips_mm[:, 1]), tips_mm[:, 2], **style)
    side.set(xlabel="distance from the axis of the base [mm]", ylabel="z [mm]", aspect="equal")
    side.set_title("from the side", loc="left")
    bar = figure.colorbar(seen, ax=side, shrink=0.9)
    bar.set_label("kept in 95 % of visits [mm]")


def _draw_space(figure: Figure, trust: Trust) -> None:
    figure.subplots_adjust(left=0.0, right=0.92, top=0.98, bottom=0.06)
    axes: Any = figure.add_subplot(projection="3d")
    _, style = _scale(trust)
    tips_mm = 1e3 * trust.sheets[0].error.tip_m
    seen = axes.scatter(tips_mm[:, 0], tips_mm[:, 1], tips_mm[:, 2], **style, depthshade=False)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
    figure.colorbar(seen, ax=axes, shrink=0.7, pad=0.1).set_label("kept in 95 % of visits [mm]")


def _draw_shares(figure: Figure, trust: Trust) -> None:
    figure.subplots_adjust(left=0.13, right=0.97, top=0.9, bottom=0.15)
    axes = figure.subplots()
    for number, payload_kg in enumerate(dict.fromkeys(one.payload_kg for one in trust.sheets)):
        reach = np.max([one.within_95_m for one in trust.of_payload(payload_kg)], axis=0)
        share = np.arange(1, len(reach) + 1) / len(reach)
        style = DASHES[number % len(DASHES)]
        axes.plot(
            1e3 * np.sort(reach), 100 * share, style, color=AFTER, label=f"{payload_kg:g} kg at the tip"
        )
    if trust.request.tolerance_m is not None:
        axes.axvline(1e3 * trust.request.tolerance_m, color=PLANNED, linewidth=1.0)
    axes.set(xlabel="distance kept in 95 % of visits [mm]", ylabel="share of the poses [%]", ylim=(0, 100))
    axes.set_xlim(left=0.0)
    axes.legend(loc="lower right")


def _draw_causes(figure: Figure, trust: Trust) -> None:
    figure.subplots_adjust(left=0.36, right=0.97, top=0.9, bottom=0.15)
    axes = figure.subplots()
    best = sorted(trust.importances, key=lambda one: one.without_m)[:CAUSES][::-1]
    axes.barh([one.name for one in best], [1e3 * one.without_m for one in best], color=AFTER, height=0.6)
    whole = np.sqrt(np.mean(np.trace(trust.sheets[0].error.systematic_m2, axis1=1, axis2=2)))
    axes.axvline(1e3 * float(whole), color=PLANNED, linewidth=1.0)
    axes.set(xlabel="uncertain if this were known [mm]; line: as it is")
    axes.grid(visible=False, axis="y")
