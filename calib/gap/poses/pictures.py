"""Pictures of static residuals, before and after: by recording, by place, and along the joint that an effect acts on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calib.arrays import Array
from calib.gap.poses.outcome import DrawnLaw, StaticGap
from calib.gap.poses.recordings import recordings
from calib.report.drawing import AFTER, BEFORE, PLANNED, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NO_TORQUE_Nm = 1e-6
ARROWS_MOST = 250  # more hide each other
ARROW_SHARE = 0.08  # of the workspace: a long arrow
SHOWN = 0.98  # of the points that the axis must hold


def recordings_picture(gap: StaticGap) -> str:
    """Root mean square of every recording over the floor, with the geometry alone and with everything named."""
    return svg((10.4, 3.4), lambda figure: _draw_recordings(figure, gap))


def places_picture(gap: StaticGap) -> str:
    """What is left at every pose as an arrow, from above and from the side, before and after at the same scale."""
    return svg((10.4, 7.6), lambda figure: _draw_places(figure, gap))


def joint_picture(gap: StaticGap, joint: int) -> str:
    """What is left along one joint (1-based) against its angle, time, load and last direction, before and after."""
    return svg((10.4, 6.4), lambda figure: _draw_joint(figure, gap, joint - 1))


def law_picture(law: DrawnLaw) -> str:
    """A named effect over its own variable: data, the textbook's law, and the law as this part has it."""
    return svg((10.4, 3.6), lambda figure: _draw_law(figure, law))


def _draw_law(figure: Figure, law: DrawnLaw) -> None:
    axes = figure.subplots()
    figure.subplots_adjust(left=0.07, right=0.99, top=0.97, bottom=0.14)
    axes.plot(
        law.at, law.data, "o", ms=2.6, color=BEFORE, alpha=0.45, mew=0, label="data, all else taken off"
    )
    axes.plot(law.at, law.whole, "x", ms=3.0, color=AFTER, alpha=0.7, label="law with its departure")
    axes.plot(law.at, law.law, ".", ms=2.6, color=PLANNED, label="law")
    reach = float(np.quantile(np.abs(law.data), SHOWN)) + 0.3 * float(np.abs(law.law).max())
    middle = float(np.median(law.data)) if law.unit == "mm" else 0.0
    axes.set(
        xlabel=law.variable, ylabel=f"{law.name.effect} [{law.unit}]", ylim=(middle - reach, middle + reach)
    )
    axes.legend(loc="best", fontsize=7)


def _draw_places(figure: Figure, gap: StaticGap) -> None:
    panels = figure.subplots(2, 2)
    figure.subplots_adjust(left=0.07, right=0.985, top=0.93, bottom=0.075, hspace=0.2, wspace=0.16)
    some = np.arange(0, len(gap.points), max(1, len(gap.points) // ARROWS_MOST))
    place = gap.problem.references_m[some]
    before = gap.stages[1][1][some]
    longest = float(np.quantile(np.linalg.norm(before, axis=1), 0.95))
    times = ARROW_SHARE * float(np.ptp(place, axis=0).max()) / max(longest, 1e-9)
    for row, (view, a, b) in enumerate((("from above", 0, 1), ("from the side", 0, 2))):
        for axes, (name, residual), colour in zip(
            panels[row], (gap.stages[1], gap.stages[-1]), (BEFORE, AFTER), strict=True
        ):
            left = residual[some]
            axes.plot(place[:, a], place[:, b], ".", ms=1.6, color=PLANNED)
            axes.quiver(
                place[:, a], place[:, b], times * left[:, a], times * left[:, b],
                angles="xy", scale_units="xy", scale=1.0, color=colour, width=0.0026,
            )  # fmt: skip
            axes.set(aspect="equal", adjustable="datalim", ylabel=f"{'xyz'[b]} [m]")
            rms = float(np.sqrt(np.mean(residual**2)))
            axes.set_title(f"{view}, {name}: {1e3 * rms:.3f} mm", size=9)
            axes.text(0.01, 0.97, f"arrows {times:.0f} times too long", transform=axes.transAxes, size=7)
    for axes in panels[1]:
        axes.set_xlabel("x [m]")


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
        "by recording (setup|payload|approach): geometry alone (squares), with what is named (circles); * held out"
    )


def _draw_joint(figure: Figure, gap: StaticGap, j: int) -> None:
    panels = figure.subplots(2, 2, sharey=True)
    figure.subplots_adjust(left=0.07, right=0.99, top=0.94, bottom=0.08, wspace=0.05, hspace=0.26)
    before, after = (along_joint_rad(gap, stage[1], j) for stage in (gap.stages[1], gap.stages[-1]))
    reach = 1e3 * float(np.quantile(np.abs(np.concatenate((before, after))), SHOWN))
    for axes, (at, label) in zip(panels.ravel(), _against(gap, j), strict=True):
        _scatter(axes, at, 1e3 * before, BEFORE, gap.stages[1][0], "s")
        _scatter(axes, at, 1e3 * after, AFTER, f"with {gap.stages[-1][0]}", "o")
        axes.set(xlabel=label, ylim=(-1.25 * reach, 1.25 * reach))
        axes.axhline(0.0, color=PLANNED, lw=0.8)
    panels[1, 1].set_xticks((-1, 0, 1))
    for axes in panels[:, 0]:
        axes.set_ylabel(f"left along joint {j + 1} [mrad]")
    panels[0, 0].legend(loc="best", fontsize=7)


def _against(gap: StaticGap, j: int) -> list[tuple[Array, str]]:
    """Four things that what is left may depend on: (m,) and its label."""
    points, count = gap.points, len(gap.points)
    has_time = bool(np.isfinite(points.t_s).all())
    apart = 0.2 * (np.arange(count) % 40 / 39.0 - 0.5)  # points of one direction side by side
    is_loaded = gap.load_Nm is not None and float(np.abs(gap.load_Nm[:, j]).max()) > NO_TORQUE_Nm
    load = gap.load_Nm[:, j] if gap.load_Nm is not None and is_loaded else np.nan_to_num(points.payload_kg)
    return [
        (np.degrees(points.q_rad[:, j]), f"q{j + 1} [deg]"),
        (points.t_s if has_time else np.arange(count, dtype=float), "time [s]" if has_time else "pose"),
        (load, f"gravity torque of joint {j + 1} [N m]" if is_loaded else "payload [kg]"),
        (points.direction[:, j] + apart, f"last direction of joint {j + 1}"),
    ]


def _scatter(axes: Axes, at: Array, values: Array, colour: str, label: str, mark: str) -> None:
    axes.plot(at, values, mark, ms=2.6, color=colour, alpha=0.55, label=label, mew=0)


def along_joint_rad(gap: StaticGap, residual_m: Array, j: int) -> Array:
    """The turn of joint j (0-based) that would explain most of each pose's residual, (m,)."""
    found = gap.problem.solution(gap.x)
    model = gap.problem.model
    slopes = model.slopes(found.dh, gap.problem.observed.q_rad, found.tool_m)
    arm = slopes.by_dh[:, :, model.theta_places[j]]
    return np.asarray(
        np.einsum("mi,mi->m", arm, residual_m) / np.maximum(np.einsum("mi,mi->m", arm, arm), 1e-12)
    )
