"""What a tolerance study says: accuracy at each stage, what each tolerance costs; as sentences and JSON."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.parameters import ANGLE_BOUND_rad, LENGTH_BOUND_m
from calib.arrays import Array
from calib.points.writer import replace_file
from calib.studies.chunks import ChunkStore
from calib.tolerances.making import MadeArms
from calib.tolerances.study import SHARE, STAGES, StudyDesign
from calib.validation.statistics import Z95, IntervalFigure, proportion, quantile

# What the study says: how accurate the arms are at each stage, and what each tolerance costs.


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
    kept = np.concatenate([part["kept_m"] for part in parts], axis=1)
    costs = [
        _cost(name, mean_square, store.read(design.chunks + k)["mean_square_m2"])
        for k, name in enumerate(design.factors)
    ]
    return Made(design, kept, mean_square, distance, tuple(costs))


def _cost(name: str, every: Array, exact: Array) -> FactorShare:
    """By mean squares (stages, arms) of arms and of the same arms with the factor exact."""
    count = exact.shape[1]
    whole = every[:, :count].mean(axis=1)
    gain = every[:, :count] - exact
    share, spread = gain.mean(axis=1) / whole, Z95 * gain.std(axis=1) / math.sqrt(count) / whole
    figures = tuple(
        IntervalFigure(float(s), float(s - d), float(s + d)) for s, d in zip(share, spread, strict=True)
    )
    left_m = np.sqrt(every.mean(axis=1) * np.maximum(0.0, 1.0 - share))
    return FactorShare(name, figures, tuple(left_m.tolist()))


def costliest(made: Made, stage: int) -> list[FactorShare]:
    """The factors by what they cost at a stage, the costliest first."""
    return sorted(made.costs, key=lambda one: -one.share[stage].value)


# The study's result in sentences and as text.


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


def warnings_about(design: StudyDesign) -> list[str]:
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
    kept = {f"{100 * share:g} %": made.kept(stage, share) for share in PERCENTILES}
    return {
        "stage": STAGES[stage],
        "kept_m": kept,
        "rms_m": made.rms_m(stage),
        "share_within_tolerance": None if tolerance_m is None else made.within(stage, tolerance_m),
        "costs": [
            {"name": one.name, "share": one.share[stage], "left_rms_m": one.left_m[stage]}
            for one in made.costs
        ],
    }
