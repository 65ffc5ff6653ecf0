"""Pictures of static residuals, before and after: by recording, and along the joint that an effect acts on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calib.arrays import Array
from calib.drawing import AFTER, BEFORE, PLANNED, svg
from calib.gap.static.find import StaticGap
from calib.gap.static.split import recordings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def recordings_picture(gap: StaticGap) -> str:
    """Root mean square of every recording over the floor, with the geometry alone and with everything named."""
    return svg((10.4, 3.4), lambda figure: _draw_recordings(figure, gap))


def joint_picture(gap: StaticGap, joint: int) -> str:
    """What is left along one joint (1-based), against its angle and against time, before and after."""
    return svg((10.4, 3.4), lambda figure: _draw_joint(figure, gap, joint - 1))


def _draw_recordings(figure: Figure, gap: StaticGap) -> None:
    axes = figure.subplots()
    figure.subplots_adjust(left=0.07, right=0.99, top=0.88, bottom=0.34)
    labels = recordings(gap.points)
    names = list(dict.fromkeys(labels.tolist()))
    place = np.arange(len(names))
    for (_, residual), colour, mark, shift in (
        (gap.stages[1], BEFORE, "s", -0.12),
        (gap.stages[-1], AFTER, "o", 0.12),
    ):
        each = [float(np.sqrt(np.mean(residual[labels == name] ** 2))) / gap.floor.tip_m for name in names]
        axes.plot(place + shift, each, mark, color=colour, ms=5)
    reported = {
        name for name, is_kept in zip(labels.tolist(), gap.split.report.tolist(), strict=True) if is_kept
    }
    axes.axhline(1.0, color=PLANNED, lw=1.0, ls="--")
    axes.set_xticks(
        place, [f"{n}{'  *' if n in reported else ''}" for n in names], rotation=35, ha="right", size=7
    )
    axes.set_ylabel("RMS over the noise")
    axes.set_title(
        "by recording (setup|payload|approach): geometry alone (squares), with what is named (circles); * kept apart"
    )


def _draw_joint(figure: Figure, gap: StaticGap, j: int) -> None:
    left, right = figure.subplots(1, 2)
    figure.subplots_adjust(left=0.07, right=0.99, top=0.88, bottom=0.15, wspace=0.16)
    angle = np.degrees(gap.points.q_rad[:, j])
    order = gap.points.t_s if np.isfinite(gap.points.t_s).all() else np.arange(len(angle), dtype=float)
    before, after = (along_joint_rad(gap, stage[1], j) for stage in (gap.stages[1], gap.stages[-1]))
    for axes, at, label in ((left, angle, f"q{j + 1} [deg]"), (right, order, "time [s]")):
        _scatter(axes, at, 1e3 * before, BEFORE, "geometry alone", "s")
        _scatter(axes, at, 1e3 * after, AFTER, "with what is named", "o")
        axes.set(xlabel=label, ylabel="left [mrad]")
    left.set_title(f"what is left along joint {j + 1}")
    left.legend(loc="best", fontsize=7)


def _scatter(axes: Axes, at: Array, values: Array, colour: str, label: str, mark: str) -> None:
    axes.plot(at, values, mark, ms=2.6, color=colour, alpha=0.55, label=label, mew=0)


def along_joint_rad(gap: StaticGap, residual_m: Array, j: int) -> Array:
    """The turn of joint j (0-based) that would explain most of each pose's residual, (m,)."""
    found = gap.fit.solution
    model = gap.fit.problem.model
    slopes = model.slopes(found.dh, gap.fit.problem.observed.q_rad, found.tool_m)
    arm = slopes.by_dh[:, :, model.theta_places[j]]
    return np.asarray(
        np.einsum("mi,mi->m", arm, residual_m) / np.maximum(np.einsum("mi,mi->m", arm, arm), 1e-12)
    )
