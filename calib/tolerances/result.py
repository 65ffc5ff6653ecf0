"""What a tolerance study says: accuracy at each stage, what each tolerance costs; as sentences, JSON and a page."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from calib.arm_problem.arm_model import ANGLE_BOUND_rad, ArmModel, LENGTH_BOUND_m
from calib.arrays import Array
from calib.points.writer import replace_file
from calib.report.page import AFTER, BEFORE, PLANNED, Section, bullets, page, pair, paragraph, svg, table, verdict
from calib.results import Provenance
from calib.studies import ChunkStore
from calib.tolerances.making import MadeArms
from calib.tolerances.study import COST_ARMS, SHARE, STAGES, StudyDesign
from calib.validation.statistics import Z95, IntervalFigure, proportion, quantile
from control.plain_text import aligned

if TYPE_CHECKING:
    from matplotlib.figure import Figure


PERCENTILES: Final = (0.05, 0.5, 0.95)


@dataclass(frozen=True, slots=True)
class FactorShare:
    """A factor: by which share the mean square error falls if it is exact, and the root mean square that is left [m].

    One of each for every stage. Shares add up to 1 where errors add up: beyond that they interact.
    """

    name: str
    share: tuple[IntervalFigure, ...]
    left_m: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Made:
    """The arms of a study, by stage.

    kept_m, mean_square_m2 (stages, arms): the distance that 95 % of an arm's poses keep, and the mean over its poses.
    distance_m (stages, first arms, poses): at each pose of the map.
    """

    design: StudyDesign
    kept_m: Array
    mean_square_m2: Array
    distance_m: Array
    costs: tuple[FactorShare, ...]

    @property
    def arms_count(self) -> int:
        """How many arms were drawn."""
        return int(self.kept_m.shape[1])

    def kept(self, stage: int, share: float) -> IntervalFigure:
        """The distance [m] that this share of the arms keep, each at 95 % of its poses."""
        return quantile(self.kept_m[stage], share)

    def rms_m(self, stage: int) -> float:
        """Root mean square over arms and poses."""
        return math.sqrt(float(self.mean_square_m2[stage].mean()))

    def within(self, stage: int, tolerance_m: float) -> IntervalFigure:
        """The share of the arms that keep a tolerance at 95 % of their poses (Wilson's interval)."""
        return proportion(int((self.kept_m[stage] <= tolerance_m).sum()), self.arms_count)

    def map_m(self, stage: int) -> Array:
        """At each pose the distance (m,) that 95 % of the arms keep."""
        return np.asarray(np.quantile(self.distance_m[stage], 0.95, axis=0))


def made_of(design: StudyDesign, store: ChunkStore) -> Made:
    """The result of a study whose tasks are all in the store."""
    parts = [store.read(number) for number in range(design.chunks)]
    mean_square = np.concatenate([part["mean_square_m2"] for part in parts], axis=1)
    distance = np.concatenate([part["distance_m"] for part in parts if "distance_m" in part], axis=1)
    kept_m = np.concatenate([part["kept_m"] for part in parts], axis=1)
    costs = [_cost(name, mean_square, store.read(design.chunks + k)["mean_square_m2"]) for k, name in enumerate(design.factors)]
    return Made(design, kept_m, mean_square, distance, tuple(costs))


def _cost(name: str, every: Array, exact: Array) -> FactorShare:
    """By mean squares (stages, arms) of arms and of the same arms with the factor exact."""
    count = exact.shape[1]
    whole = every[:, :count].mean(axis=1)
    gain = every[:, :count] - exact
    share, spread = gain.mean(axis=1) / whole, Z95 * gain.std(axis=1) / math.sqrt(count) / whole
    figures = tuple(IntervalFigure(float(s), float(s - d), float(s + d)) for s, d in zip(share, spread, strict=True))
    left_m = np.sqrt(every.mean(axis=1) * np.maximum(0.0, 1.0 - share))
    return FactorShare(name, figures, tuple(left_m.tolist()))


def costliest(made: Made, stage: int) -> list[FactorShare]:
    """The factors by what they cost at a stage, the costliest first."""
    return sorted(made.costs, key=lambda one: -one.share[stage].value)


LISTED = 8
COSTS_HEAD = ("error less by", "left [mm]")
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


def warnings_about(design: StudyDesign) -> list[str]:
    """What the real commands could not do as the study does it."""
    made = MadeArms(design.arm, design.tolerances)
    geometry = 4 * len(design.arm.links)
    off = np.abs(made.drawn(np.random.default_rng(1), SAMPLE)[:, :geometry])
    bounds = np.tile([LENGTH_BOUND_m, ANGLE_BOUND_rad], geometry // 2)
    cautions = []
    if float(np.mean((off > bounds).any(axis=1))) > BEYOND:
        cautions.append(
            "some arms deviate by more than calibrate's bounds of 5 mm and 2 deg, which the study does not enforce: give"
            " `armwright calibrate` wider ones"
        )
    unknowns = geometry + len(made.correctable)
    if 3 * len(design.calibration) < 2 * unknowns:
        cautions.append(
            f"{len(design.calibration)} poses are few for {unknowns} parameters: the arms differ by chance in what is left"
        )
    return cautions


def stage_rows(made: Made, tolerance_m: float | None) -> list[tuple[str, ...]]:
    """For each stage: what half and 95 % of the arms keep, the root mean square, and the share within the tolerance."""
    rows = []
    for stage, name in enumerate(STAGES):
        cells = (_mm(made.kept(stage, 0.5)), _mm(made.kept(stage, 0.95)), f"{1e3 * made.rms_m(stage):.3g} mm")
        share = () if tolerance_m is None else (_percent(made.within(stage, tolerance_m)),)
        rows.append((name, *cells, *share))
    return rows


def stage_heading(tolerance_m: float | None) -> tuple[str, ...]:
    """The columns of `stage_rows`."""
    share = () if tolerance_m is None else (f"arms that keep {1e3 * tolerance_m:.3g} mm",)
    return ("", "half of the arms keep", "95 % of the arms keep", "root mean square", *share)


def cost_rows(made: Made, stage: int) -> list[tuple[str, str, str]]:
    """The costliest tolerances: name, share of the mean square error, what is left if it is exact [mm]."""
    return [(one.name, _percent(one.share[stage]), f"{1e3 * one.left_m[stage]:.3f}") for one in costliest(made, stage)[:LISTED]]


def as_text(made: Made, tolerance_m: float | None) -> str:
    """What the command prints."""
    lines = list(sentences(made, tolerance_m))
    for stage, name in enumerate(STAGES):
        head = (f"{name}: if this were exact", *COSTS_HEAD)
        lines += ["", aligned([head, *cost_rows(made, stage)], indent="  ")]
    return "\n".join(lines) + "\n"


def _mm(one: IntervalFigure) -> str:
    return f"{1e3 * one.value:.3g} mm ({1e3 * one.lower:.3g} to {1e3 * one.upper:.3g})"


def _percent(one: IntervalFigure) -> str:
    return f"{100 * one.value:.1f} % ({100 * one.lower:.1f} to {100 * one.upper:.1f})"


# tolerances.json for programs and map.npz: formats in docs/formats.md.


FORMAT = "tolerances/1"


def write_map(file: Path, made: Made) -> None:
    """The map as arrays [SI]: the first axis of errors is the stage."""
    at, arm = made.design.map, made.design.arm
    content = io.BytesIO()
    np.savez_compressed(
        content,
        stage=np.array(STAGES),
        q_rad=at.q_rad,
        direction=at.direction,
        tip_m=ArmModel(arm).tips(arm.dh, at.q_rad),
        rms_m=np.sqrt(np.mean(made.distance_m**2, axis=1)),
        median_m=np.median(made.distance_m, axis=1),
        within_95_m=np.array([made.map_m(stage) for stage in range(len(STAGES))]),
        kept_m=made.kept_m,
    )
    replace_file(file, content.getvalue())


def made_json(made: Made, tolerance_m: float | None) -> dict[str, object]:
    """The result for programs; SI units."""
    design = made.design
    return {
        "arms": made.arms_count,
        "seed": design.seed,
        "calibration": {"poses": len(design.calibration), "noise_m": design.tolerances.noise_m},
        "share_of_poses": SHARE,
        "tolerance_m": tolerance_m,
        "stages": [_stage(made, stage, tolerance_m) for stage in range(len(STAGES))],
        "in_words": sentences(made, tolerance_m),
    }


def _stage(made: Made, stage: int, tolerance_m: float | None) -> dict[str, object]:
    kept_m = {f"{100 * share:g} %": made.kept(stage, share) for share in PERCENTILES}
    return {
        "stage": STAGES[stage],
        "kept_m": kept_m,
        "rms_m": made.rms_m(stage),
        "share_within_tolerance": None if tolerance_m is None else made.within(stage, tolerance_m),
        "costs": [{"name": one.name, "share": one.share[stage], "left_rms_m": one.left_m[stage]} for one in made.costs],
    }


# The page of the tolerance study, and its pictures: how many arms keep what, where errors are large, what
# costs what.


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
            away_mm, tips_mm[:, 2], c=kept_mm, cmap=COLOURS, vmin=0.0, vmax=float(np.quantile(kept_mm, 0.98)), s=12
        )
        axes.set(xlabel="distance from the axis of the base [mm]", ylabel="z [mm]", aspect="equal")
        axes.set_title(STAGES[stage], loc="left")
        figure.colorbar(seen, ax=axes, shrink=0.9).set_label("95 % of the arms keep [mm]")


def _draw_costs(figure: Figure, made: Made) -> None:
    figure.subplots_adjust(left=0.15, right=0.98, top=0.9, bottom=0.15, wspace=1.0)
    for stage, axes in enumerate(figure.subplots(1, len(STAGES))):
        first = costliest(made, stage)[:BARS][::-1]
        shares = np.array([[cost.share[stage].value, cost.share[stage].lower, cost.share[stage].upper] for cost in first])
        spread = 100 * np.abs(shares[:, 1:] - shares[:, :1]).T
        axes.barh(
            [cost.name for cost in first],
            100 * shares[:, 0],
            xerr=spread,
            color=STYLES[stage][0],
            height=0.6,
            error_kw={"elinewidth": 0.8},
        )
        axes.set(xlabel="mean square error less if exact [%]")
        axes.set_title(STAGES[stage], loc="left")
        axes.grid(visible=False, axis="y")


ABOUT = (
    "As built: the arm's file is nominal. Calibrated: geometry identified from the calibration's poses. Corrected: backlash,"
    " stiffness, bending, scale and eccentricity identified too, as far as they have a tolerance: the best that `gap` can do."
)
COSTS = (
    "By how much the mean square error falls if one tolerance is exact and the others are as they are"
    f" ({COST_ARMS} arms, 95 % intervals). Shares add up to more than 100 % where errors add up in one direction."
)


def tolerances_report(made: Made, tolerance_m: float | None, warnings: Sequence[str], provenance: Provenance) -> str:
    """The page."""
    head = ("tolerance", *COSTS_HEAD)
    costs = [f"<h3>{name}</h3>{table(head, cost_rows(made, stage))}" for stage, name in enumerate(STAGES)]
    stages = table(stage_heading(tolerance_m), stage_rows(made, tolerance_m))
    parts: list[Section | str] = [
        verdict(sentences(made, tolerance_m)),
        Section("How accurate the arms are", paragraph(ABOUT) + stages + shares_picture(made, tolerance_m)),
        Section("Over the workspace", map_picture(made)),
        Section("What costs most", paragraph(COSTS) + costs_picture(made) + pair(costs[0], costs[1]) + costs[2]),
    ]
    if warnings:
        parts.append(Section("Warnings", bullets(warnings)))
    return page("Arms made to these tolerances", made.design.arm.name, provenance.line, parts)
