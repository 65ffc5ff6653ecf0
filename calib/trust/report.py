"""ISO 9283's pose accuracy and repeatability: predicted for the poses of a recorded programme, beside the measured ones.

Each draw is an arm that the points allow and one run of the programme: its errors, and the scatter of every visit, that of the
measurement included. AP_p and RP_l of a draw are as the standard has them (ISO 9283:1998, 7.2), for as many visits as recorded.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from calib.arm_problem.link_bending import known_bending
from calib.arrays import Array, norms
from calib.iso9283 import pose_criteria
from calib.iso9283.evaluate_poses import is_pose_setup
from calib.iso9283.recorded import pose_groups
from calib.points.points import Points
from calib.points.writer import replace_file
from calib.report.page import AFTER, PLANNED, Section, bullets, page, pair, paragraph, svg, table, verdict
from calib.results import Provenance, entries
from calib.trust.discrepancy import Conditions
from calib.trust.prediction import Predictor, Reliability
from calib.trust.trust import Trust, share_within
from calib.validation.statistics import IntervalFigure
from control.model.arm import Arm

if TYPE_CHECKING:
    from matplotlib.figure import Figure


DRAWS: Final = 400


@dataclass(frozen=True, slots=True)
class PoseFigures:
    """A pose: AP_p and RP_l [m] as predicted (median and 95 % interval) and as measured; None without enough visits."""

    where: str
    visits: int
    accuracy_m: IntervalFigure
    repeatability_m: IntervalFigure | None
    measured_accuracy_m: float | None
    measured_repeatability_m: float | None


def pose_figures(predictor: Predictor, arm: Arm, points: Points, path: Path) -> tuple[PoseFigures, ...]:
    """Of every pose of the plain programmes in points.csv of `armwright iso9283`."""
    groups, _ = pose_groups(points, arm, path)
    keys = list(zip(points.setup, points.point, strict=True))
    figures = []
    for group in groups:
        if not is_pose_setup(group.setup):
            continue
        rows = [k for k, key in enumerate(keys) if key == (group.setup, group.point)]
        visits = points.chosen(rows)
        at = Conditions.recorded(arm, visits)
        bent = known_bending(arm, at.q_rad, at.payload_kg)
        wanted = group.commanded_m - (0.0 if bent is None else bent.shift)
        off = _drawn(predictor, at, wanted)
        attained, n = group.attained_m, len(group.attained_m)
        figures.append(
            PoseFigures(
                f"{group.setup} {group.point}",
                len(rows),
                _figure(norms(off.mean(axis=1))),
                _figure(_repeatability(off)) if len(rows) > 1 else None,
                pose_criteria.pose_accuracy(group.commanded_m, attained).total_m if n else None,
                pose_criteria.pose_repeatability(attained) if n > 1 else None,
            )
        )
    return tuple(figures)


def _drawn(predictor: Predictor, at: Conditions, commanded_m: Array) -> Array:
    """Attained minus commanded position (3,) or (m, 3) of each draw and visit, (DRAWS, m, 3)."""
    error, columns, posterior = predictor.at(at), predictor.columns(at), predictor.posterior
    drawn, rng = posterior.draws(DRAWS, 0), np.random.default_rng(1)
    same = (drawn - posterior.mean) @ columns.reshape(-1, columns.shape[2]).T
    measuring_m2 = max(0.0, posterior.noise_m**2 - predictor.repeat_m**2)
    scatter = np.linalg.cholesky(predictor.seated_m2(at) + (measuring_m2 + 1e-18) * np.eye(3))
    normal = rng.standard_normal((DRAWS, len(at), 3))
    usual = error.tip_m + error.expected_m - commanded_m
    play = predictor.drawn_play_m(at, drawn, rng)
    return np.asarray(usual + same.reshape(DRAWS, -1, 3) + play + np.einsum("mij,dmj->dmi", scatter, normal))


def _repeatability(off: Array) -> Array:
    """RP_l of each draw (d,)."""
    lengths = np.linalg.norm(off - off.mean(axis=1, keepdims=True), axis=2)
    return np.asarray(lengths.mean(axis=1) + pose_criteria.SIGMAS * lengths.std(axis=1, ddof=1))


def _figure(drawn: Array) -> IntervalFigure:
    lower, middle, upper = (float(value) for value in np.quantile(drawn, (0.025, 0.5, 0.975)))
    return IntervalFigure(middle, lower, upper)


def pose_rows(figures: Sequence[PoseFigures]) -> list[tuple[str, ...]]:
    """Cells [mm] of a table: pose, visits, AP_p predicted and measured, RP_l predicted and measured."""
    return [
        (
            figure.where,
            f"{figure.visits}",
            _interval(figure.accuracy_m),
            _cell_mm(figure.measured_accuracy_m),
            _interval(figure.repeatability_m),
            _cell_mm(figure.measured_repeatability_m),
        )
        for figure in figures
    ]


def pose_json(figures: Sequence[PoseFigures]) -> list[dict[str, object]]:
    """For programs; SI."""
    return [
        {
            "where": figure.where,
            "visits": figure.visits,
            **{
                name: {
                    "predicted": predicted and predicted.value,
                    "lower": predicted and predicted.lower,
                    "upper": predicted and predicted.upper,
                    "measured": measured,
                }
                for name, predicted, measured in (
                    ("AP_p_m", figure.accuracy_m, figure.measured_accuracy_m),
                    ("RP_l_m", figure.repeatability_m, figure.measured_repeatability_m),
                )
            },
        }
        for figure in figures
    ]


def _interval(figure: IntervalFigure | None) -> str:
    if figure is None:
        return ""
    return f"{1e3 * figure.value:.3f} ({1e3 * figure.lower:.3f} to {1e3 * figure.upper:.3f})"


def _cell_mm(length_m: float | None) -> str:
    return "" if length_m is None else f"{1e3 * length_m:.3f}"


# What an error map says: sentences and text, report.html with its pictures, trust.json and map.npz (docs/formats.md).


ABOUT = (
    "Colours: the distance from where the arm's file puts the tip that one visit keeps in 95 % of cases, from either direction"
    " of approach. It counts what is expected and not corrected, what the points do not determine, and what scatters."
)


def trust_report(trust: Trust, tasks: Sequence[Reliability], poses: Sequence[PoseFigures], made: Provenance) -> str:
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
            table(("if this were known exactly", "left [mm]", "expected [mm]"), cause_rows(trust)) + causes_picture(trust),
        ),
    ]
    if trust.warnings:
        parts.append(Section("Warnings", bullets(trust.warnings)))
    return page("How far the arm can be trusted", trust.arm.name, made.line, parts)


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
        axes.plot(1e3 * np.sort(reach), 100 * share, style, color=AFTER, label=f"{payload_kg:g} kg at the tip")
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


# The result in sentences and as text.

LISTED = 6
POSE_HEAD = ("ISO 9283", "visits", "AP_p predicted [mm]", "measured", "RP_l predicted [mm]", "measured")
CORRECTABLE = 2.0  # expected over uncertain error, from which the file is worth correcting
COVERED_LEAST = 0.9  # of held-out poses inside 95 % ellipsoids: with fewer, the intervals are too narrow


def sentences(trust: Trust) -> tuple[str, ...]:
    """What the map says, the most useful first."""
    return tuple(_sentences(trust))


def _sentences(trust: Trust) -> Iterator[str]:
    reach = trust.within_95_m
    yield (
        f"The tip of arm {trust.arm.name} is within {_mm(np.median(reach))} of where its file puts it, in 95 % of visits"
        f" and at half of {len(reach)} poses over its workspace; at the worst pose within {_mm(reach.max())}."
    )
    if trust.request.tolerance_m is not None:
        share = share_within(reach, trust.request.tolerance_m)
        yield f"{100 * share:.0f} % of the poses keep {_mm(trust.request.tolerance_m)} in 95 % of visits."
    yield from _about_coverage(trust)
    expected = float(np.sqrt(np.mean(np.sum(trust.sheets[0].error.expected_m ** 2, axis=1))))
    uncertain = float(np.sqrt(np.mean(np.trace(trust.sheets[0].error.systematic_m2, axis1=1, axis2=2))))
    if expected > CORRECTABLE * uncertain:
        yield (
            f"Most of it can be corrected: {_mm(expected)} are known from these points (root mean square), {_mm(uncertain)}"
            " are not. Run `armwright calibrate`, then `armwright gap`."
        )
    elif trust.importances:
        first = min(trust.importances, key=lambda one: one.without_m)
        yield (
            f'Most of it is not known from these points: {_mm(uncertain)} (root mean square). If "{first.name}" were known'
            f" exactly, {_mm(first.without_m)} would be left. `armwright plan-poses --criterion tip` proposes points."
        )
    if not trust.predictor.is_tied:
        yield "The arm's base is not tied to a known place: the errors exclude a rigid motion of the whole workspace."


def _about_coverage(trust: Trust) -> Iterator[str]:
    coverage = trust.coverage
    if coverage is None:
        yield "Too few points to leave some out: the intervals are not checked."
        return
    yield (
        f"Checked on points left out in turn: {coverage.inside} of {coverage.count} lie inside their 95 % ellipsoids ("
        f"{100 * coverage.share:.0f} %); predicted {_mm(coverage.predicted_m)}, found {_mm(coverage.left_m)} (root mean square)."
    )
    if coverage.share < COVERED_LEAST:
        yield (
            "The intervals are too narrow for these points: look for outliers (`armwright calibrate`) and effects"
            " (`armwright gap`)."
        )


def task_sentences(task: Reliability) -> tuple[str, ...]:
    """The probability of a task, and where it is worst."""
    low, high = task.interval
    q95 = float(np.quantile(task.largest_m, 0.95))
    return (
        f"The path keeps {_mm(task.tolerance_m)} with a probability of {100 * task.probability:.1f} %"
        f" ({100 * low:.1f} to {100 * high:.1f} %, {task.draws} draws).",
        f"Its largest error is {_mm(float(np.median(task.largest_m)))} in the median and below {_mm(q95)} in 95 % of"
        f" draws; on average it is largest at {task.worst_time_s:.2f} s of {task.duration_s:.2f} s.",
    )


def cause_rows(trust: Trust) -> list[tuple[str, str, str]]:
    """The causes that would help most if they were known: name, uncertain without them, expected [mm]."""
    best = sorted(trust.importances, key=lambda one: one.without_m)[:LISTED]
    return [(one.name, f"{1e3 * one.without_m:.3f}", f"{1e3 * one.expected_m:.3f}") for one in best]


def as_text(trust: Trust, tasks: tuple[Reliability, ...], poses: tuple[PoseFigures, ...]) -> str:
    """What the command prints."""
    lines = [*sentences(trust), *(line for one in tasks for line in task_sentences(one))]
    rows = [f"  {name:<28}{left:>14}{expected:>14}" for name, left, expected in cause_rows(trust)]
    head = f"  {'if this were known exactly':<28}{'left [mm]':>14}{'expected [mm]':>14}"
    return "\n".join([*lines, "", head, *rows, *_pose_lines(poses)]) + "\n"


def _pose_lines(poses: tuple[PoseFigures, ...]) -> list[str]:
    form = "  {:<14}{:>7}{:>28}{:>10}{:>26}{:>10}"
    rows = [form.format(*cells) for cells in pose_rows(poses)]
    return ["", form.format(*POSE_HEAD), *rows] if rows else []


def _mm(length_m: float) -> str:
    return f"{1e3 * float(length_m):.3g} mm"


# map.npz for programs and trust.json for everybody: formats in docs/formats.md.

FORMAT = "trust/1"


def write_map(file: Path, trust: Trust) -> None:
    """The map as arrays [SI]: the first axis of errors is the sheet, a payload and a direction of approach."""
    sheets = trust.sheets
    content = io.BytesIO()
    np.savez_compressed(
        content,
        q_rad=trust.q_rad,
        tip_m=sheets[0].error.tip_m,
        payload_kg=np.array([sheet.payload_kg for sheet in sheets]),
        direction=np.array([sheet.direction for sheet in sheets]),
        expected_m=np.array([sheet.error.expected_m for sheet in sheets]),
        systematic_m2=np.array([sheet.error.systematic_m2 for sheet in sheets]),
        random_m2=np.array([sheet.error.random_m2 for sheet in sheets]),
        within_95_m=np.array([sheet.within_95_m for sheet in sheets]),
    )
    replace_file(file, content.getvalue())


def trust_json(trust: Trust, tasks: Sequence[Reliability], poses: Sequence[PoseFigures]) -> dict[str, object]:
    """The result for programs; SI units."""
    reach, tolerance = trust.within_95_m, trust.request.tolerance_m
    coverage = trust.coverage
    return {
        "poses": len(reach),
        "within_95_m": {"median": np.median(reach), "largest": reach.max()},
        "tolerance_m": tolerance,
        "share_within_tolerance": share_within(reach, tolerance) if tolerance is not None else None,
        "noise_m": trust.posterior.noise_m,
        "measuring_noise_m": trust.measuring_noise_m,
        "is_tied_to_base": trust.predictor.is_tied,
        "held_out": coverage
        and {
            "points": coverage.count,
            "inside_95": coverage.inside,
            "nominal_rms_m": coverage.without_m,
            "left_rms_m": coverage.left_m,
            "predicted_rms_m": coverage.predicted_m,
        },
        "causes": [entries(cause, "name", "expected_m", "uncertain_m", "without_m") for cause in trust.importances],
        "sizes": dict(zip((source.name for source in trust.discrepancy.sources), trust.posterior.sizes, strict=True)),
        "tasks": [_task_json(task) for task in tasks],
        "iso9283": pose_json(poses),
        "in_words": [*sentences(trust), *(line for task in tasks for line in task_sentences(task))],
        "warnings": trust.warnings,
    }


def _task_json(task: Reliability) -> dict[str, object]:
    low, high = task.interval
    return entries(task, "tolerance_m", "probability", "draws", "worst_time_s", "duration_s") | {
        "lower": low,
        "upper": high,
        "largest_median_m": np.median(task.largest_m),
        "largest_95_m": np.quantile(task.largest_m, 0.95),
    }
