"""Static poses from end to end: floor, what could be named, what is named, what is left, and the gap on held-out poses."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, Mask
from calib.errors import UnusablePointsError
from calib.gap.finding import GapFinding, Nameable, Unknown
from calib.gap.poses.candidate import Candidate
from calib.gap.poses.candidates import candidates
from calib.gap.poses.currents import holding_currents
from calib.gap.poses.floor import Floor, noise_floor
from calib.gap.poses.generic import load_of
from calib.gap.poses.model import Fitted, fitted
from calib.gap.static.cautions import about_data, about_fit, about_outliers, cleaned, require_posed
from calib.gap.static.decision import Decision
from calib.gap.static.experiments import next_experiment
from calib.gap.static.linearised import Linearised
from calib.gap.static.nameable import nameable
from calib.gap.static.naming import named, rms, stages
from calib.gap.static.outlying import outlying
from calib.gap.static.search import Search, working_noise_m
from calib.gap.static.split import Split, split
from calib.points.points import Points
from control.model.arm import Arm
from control.progress import Advance, silent

FREEDOM_LEAST = 60  # values beyond all parameters that a noise from the richest model needs


@dataclass(frozen=True, slots=True)
class StaticGap:
    """The finding, and what its report draws: poses, their split, residuals (m, 3) as the model grows, stage by stage.

    `warnings`: what is odd about the data, and what the answer is worth less for. `left_out` (m,): poses that no model explains.
    `load_Nm` (m, n): gravity's torques; None for an arm without masses.
    """

    finding: GapFinding
    points: Points
    split: Split
    floor: Floor
    stages: tuple[tuple[str, Array], ...]
    fit: Fitted
    warnings: tuple[str, ...]
    left_out: Mask
    load_Nm: Array | None


def find(
    arm: Arm,
    points: Points,
    advance: Advance = silent,
    without: Collection[str] = (),
    source: str = "points.csv",
) -> StaticGap:
    """Name what is missing in the model of `arm` at these poses; `without` leaves effects out of the list.

    UnusablePointsError for points of which nothing can be said.
    """
    advance("reading the poses", 0.0)
    warnings = [*require_posed(arm, points), *about_data(arm, points)]
    points = cleaned(points)
    advance("fitting the geometry", 0.05)
    tried = tuple(one for one in candidates(arm, points) if one.name.effect not in without)
    search, out = _prepared(arm, points, tried)
    warnings += about_outliers(points, out)
    advance("weighing effects", 0.3)
    search, decision, fit = search.searched()
    advance("looking for what is left", 0.6)
    verdict = search.judged(decision, fit)
    advance("reporting", 0.85)
    fits = stages(arm, points, search.parts, search.bare, verdict.kept)
    nominal = search.bare.problem.residuals(np.zeros(len(search.bare.x)))
    final = fits[-1][1]
    warnings += about_fit(arm, search.parts, search.floor, final, search.noise_m)
    could = nameable(search.around(fit.geometry_x), search.tried, search.parts.known)
    finding = _finding(search, decision, verdict.unknown, fits, nominal, could, source)
    drawn = (("as it is", nominal), *((name, one.residual_m) for name, one in fits))
    return StaticGap(
        finding, points, search.parts, search.floor, drawn, final, tuple(warnings), out, load_of(arm, points)
    )


def _finding(
    search: Search,
    decision: Decision,
    unknown: Unknown | None,
    fits: Sequence[tuple[str, Fitted]],
    nominal_m: Array,
    could: tuple[Nameable, ...],
    source: str,
) -> GapFinding:
    """What was decided, with the gap on the poses that were used for nothing else."""
    parts, floor, final = search.parts, search.floor, fits[-1][1]
    before, after = (rms(residual, final.sure(parts.report)) for residual in (nominal_m, final.residual_m))
    ambiguous = decision.ambiguous if unknown is None else ()
    return GapFinding(
        arm=search.arm.name,
        data=(source,),
        noise_floor={"tip_m": floor.tip_m},
        gap_before=before / floor.tip_m,
        gap_after=after / floor.tip_m,
        before_si={"tip_m": before},
        after_si={"tip_m": after},
        effects=named(fits, parts, floor, decision.margin, nominal_m, search.currents),
        ambiguous=ambiguous,
        unknown=unknown,
        nameable=could,
        next_experiment=next_experiment(ambiguous, unknown, could, "free" in search.points.setup),
        is_held_out=parts.is_divided,
    )


def _prepared(arm: Arm, points: Points, tried: tuple[Candidate, ...]) -> tuple[Search, Mask]:
    """The geometry alone fitted, outliers left out (m,), the noise found."""
    parts = split(points)
    bare = fitted(arm, points, parts.known)
    whole = bare if parts.known.all() else fitted(arm, points, np.ones(len(points), dtype=bool))
    out = outlying(Linearised.around(whole.problem, whole.x, _scatter_m(arm, points, whole)), tried)
    if out.any():
        parts = parts.without(out)
        bare = fitted(arm, points, parts.known)
    floor = noise_floor(arm, points, bare.residual_m, out)
    if not np.isfinite(floor.tip_m):
        floor = _from_the_richest(bare, parts, tried)
    noise = working_noise_m(bare, parts.known, tried, floor.tip_m)
    currents = holding_currents(arm, points, tried)
    return Search(arm, points, parts, tried, arm, bare, floor, noise, currents), out


def _scatter_m(arm: Arm, points: Points, whole: Fitted) -> float:
    """A first idea of the noise: that of repeats or the data sheet, else of what the better half of the poses leave."""
    floor = noise_floor(arm, points, whole.residual_m)
    return floor.tip_m if math.isfinite(floor.tip_m) else float(np.median(np.abs(whole.residual_m))) / 0.6745


def _from_the_richest(bare: Fitted, parts: Split, tried: tuple[Candidate, ...]) -> Floor:
    """The noise as what every effect of the list together leaves, where nothing else tells it.

    UnusablePointsError where the poses are too few for that.
    """
    scale = bare.rms_m(parts.known)
    evidence = Linearised.around(bare.problem, bare.x, scale).evidence(tried, parts.known)
    columns = len(evidence.pull)
    freedom = evidence.count - len(bare.x) - columns
    if freedom < FREEDOM_LEAST:
        raise UnusablePointsError(
            "the noise of these points is not known: repeat a dozen of them, or give [camera] position_noise_m in arm.toml"
        )
    left = evidence.left_with(range(columns)) / freedom
    return Floor(
        scale * float(np.sqrt(left)),
        "what the list of effects leaves when all are fitted: there are no repeats and no camera's noise, so that an effect"
        " beyond the list would pass for noise",
    )
