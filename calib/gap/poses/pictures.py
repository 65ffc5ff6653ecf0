"""Pictures of static residuals, before and after: by recording, by place, and along the joint that an effect acts on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from calib.arrays import Array
from calib.gap.poses.outcome import StaticGap
from calib.report.drawing import AFTER, BEFORE, PLANNED, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NO_TORQUE_Nm = 1e-6
ARROWS_MOST = 250  # more hide each other
ARROW_SHARE = 0.08  # of the workspace: a long arrow
NAMES_MOST = 40  # recordings on one axis
SHOWN = 0.98  # of the points that the axis must hold


def recordings_picture(gap: StaticGap) -> str:
    """Root mean square of every recording over the floor, with the geometry alone and with everything named."""
    return svg((10.4, 3.4), lambda figure: _draw_recordings(figure, gap))


def places_picture(gap: StaticGap) -> str:
    """What is left at every pose as an arrow, from above and from the side, before and after at the same scale."""
    return svg((10.4, 3.8 * len(_compared(gap))), lambda figure: _draw_places(figure, gap))


def joint_picture(gap: StaticGap, joint: int) -> str:
    """What is left along one joint (1-based) against its angle, time, load and last direction, before and after."""
    rows = 1 if len(_varying(gap, joint - 1)) < 3 else 2
    return svg((10.4, 3.2 * rows), lambda figure: _draw_joint(figure, gap, joint - 1))


def _draw_places(figure: Figure, gap: StaticGap) -> None:
    stages = _compared(gap)
    panels = figure.subplots(len(stages), 2, squeeze=False)  # a row each stage; from above, and from the side
    figure.subplots_adjust(
        left=0.07, right=0.985, top=1 - 0.07 / len(stages), bottom=0.13 / len(stages), wspace=0.16
    )
    some = np.arange(0, len(gap.points), max(1, len(gap.points) // ARROWS_MOST))
    place = gap.problem.references_m[some]
    before = stages[0][1][some]
    longest = float(np.quantile(np.linalg.norm(before, axis=1), 0.95))
    times = ARROW_SHARE * float(np.ptp(place, axis=0).max()) / max(longest, 1e-9)
    for column, (view, a, b) in enumerate((("from above", 0, 1), ("from the side", 0, 2))):
        for axes, (name, residual), colour in zip(panels[:, column], stages, (BEFORE, AFTER), strict=False):
            left = residual[some]
            axes.plot(place[:, a], place[:, b], ".", ms=1.6, color=PLANNED)
            axes.quiver(
                place[:, a], place[:, b], times * left[:, a], times * left[:, b],
                angles="xy", scale_units="xy", scale=1.0, color=colour, width=0.0026,
            )  # fmt: skip
            axes.margins(2.0 * ARROW_SHARE)
            axes.set(aspect="equal", adjustable="datalim", ylabel=f"{'xyz'[b]} [m]")
            rms = float(np.sqrt(np.mean(residual**2)))
            axes.set_title(f"{view}, {name}: {1e3 * rms:.3f} mm", size=9)
            axes.text(
                0.01, 0.97, f"arrows {times:.0f} times too long", transform=axes.transAxes, size=7, va="top"
            )
    for axes in panels[-1]:
        axes.set_xlabel("x [m]")


def _compared(gap: StaticGap) -> list[tuple[str, Array]]:
    """The geometry alone, and with everything named where there is anything."""
    last = [(f"with {gap.stages[-1][0]}", gap.stages[-1][1])] if len(gap.stages) > 2 else []
    return [gap.stages[1], *last]


def _draw_recordings(figure: Figure, gap: StaticGap) -> None:
    axes = figure.subplots()
    figure.subplots_adjust(left=0.07, right=0.99, top=0.88, bottom=0.34)
    labels, names = _recordings(gap)
    place = np.arange(len(names))
    stages = _compared(gap)
    for (name, residual), colour, mark, shift in zip(
        stages, (BEFORE, AFTER), "so", (-0.06, 0.06), strict=False
    ):
        each = [float(np.sqrt(np.mean(residual[labels == one] ** 2))) / gap.floor.tip_m for one in names]
        axes.plot(place + shift, each, mark, color=colour, ms=5, label=name)
    report = gap.split.report if not gap.split.is_by_pose else np.zeros(len(labels), dtype=bool)
    kept = {one for one, is_kept in zip(labels.tolist(), report.tolist(), strict=True) if is_kept}
    axes.axhline(1.0, color=PLANNED, lw=1.0, ls="--")
    axes.set_xticks(
        place, [f"{one}{'  *' if one in kept else ''}" for one in names], rotation=35, ha="right", size=7
    )
    axes.set_xlim(-0.6, len(names) - 0.4)
    axes.set_ylabel("RMS over the noise")
    axes.legend(loc="best", fontsize=7)
    axes.set_title("by recording; * held out" if kept else "by recording; some poses of each are held out")


def _recordings(gap: StaticGap) -> tuple[npt.NDArray[np.str_], list[str]]:
    """The recording of each pose in words, (m,), and all of them; setups alone where there are too many."""
    points = gap.points
    has_load, has_side = bool(np.nan_to_num(points.payload_kg).any()), bool(points.direction.any())
    words = []
    for setup, payload, direction in zip(points.setup, points.payload_kg, points.direction, strict=True):
        side = "".join("-0+"[int(last) + 1] for last in direction)
        words.append(", ".join([setup, *([f"{payload:g} kg"] * has_load), *([side] * has_side)]))
    if len(set(words)) > NAMES_MOST:
        words = list(points.setup)
    return np.array(words), list(dict.fromkeys(words))


def _draw_joint(figure: Figure, gap: StaticGap, j: int) -> None:
    sides = _varying(gap, j)
    panels = figure.subplots(1 if len(sides) < 3 else 2, min(len(sides), 2), sharey=True, squeeze=False)
    figure.subplots_adjust(left=0.07, right=0.99, top=0.95, bottom=0.14, wspace=0.05, hspace=0.3)
    stages = [(name, along_joint_rad(gap, residual, j)) for name, residual in _compared(gap)]
    reach = 1e3 * float(np.quantile(np.abs(np.concatenate([own for _, own in stages])), SHOWN))
    for axes, (at, label) in zip(panels.ravel(), sides, strict=False):
        for (name, own), colour, mark in zip(stages, (BEFORE, AFTER), "so", strict=False):
            _scatter(axes, at, 1e3 * own, colour, name, mark)
        axes.set(xlabel=label, ylim=(-1.25 * reach, 1.25 * reach))
        axes.axhline(0.0, color=PLANNED, lw=0.8)
        if label.startswith("last direction"):
            axes.set_xticks((-1, 0, 1))
    for axes in panels.ravel()[len(sides) :]:
        axes.set_visible(False)
    for axes in panels[:, 0]:
        axes.set_ylabel(f"residual along joint {j + 1} [mrad]")
    panels[0, 0].legend(loc="best", fontsize=7)


def _varying(gap: StaticGap, j: int) -> list[tuple[Array, str]]:
    """Those of what may matter that are not the same in all poses."""
    return [(at, label) for at, label in _against(gap, j) if float(np.ptp(at)) > 0.0]


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
        (
            points.direction[:, j] + apart * bool(np.ptp(points.direction[:, j])),
            f"last direction of joint {j + 1}",
        ),
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
