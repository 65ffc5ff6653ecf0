"""Static poses from end to end: floor, what could be named, what is named, what is left, and the gap on poses kept apart."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, Mask
from calib.errors import UnusablePointsError
from calib.gap.finding import EffectName, GapFinding, NamedEffect, Unknown
from calib.gap.static.candidates import Candidate, candidates
from calib.gap.static.decision import Decision, decide, with_doubt
from calib.gap.static.doubles import doubles
from calib.gap.static.evidence import Evidence
from calib.gap.static.experiments import next_experiment
from calib.gap.static.floor import Floor, noise_floor
from calib.gap.static.generic import Shape, shapes
from calib.gap.static.judgement import Judgement, explained_share, judge
from calib.gap.static.linearised import Linearised
from calib.gap.static.model import Fitted, fitted, parameters_of
from calib.gap.static.nameable import nameable
from calib.gap.static.remainder import remainders
from calib.gap.static.split import Split, split
from calib.points import Points
from control.model.arm import Arm

LOOKS = 3  # the geometry moves when an effect joins it, and the evidence is linear around it: look again
GEOMETRY_PAYS = 40.0  # mean square of chi-square beyond its count that 16 refitted parameters must gain
FREEDOM_LEAST = 60  # values beyond all parameters that a noise from the richest model needs
KINDS = ("d_m", "theta_rad", "L_m", "alpha_rad")

Advance = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class StaticGap:
    """The finding, and what its report draws: poses, their split, residuals (m, 3) as the model grows, stage by stage."""

    finding: GapFinding
    points: Points
    split: Split
    floor: Floor
    stages: tuple[tuple[str, Array], ...]
    fit: Fitted


def find(
    arm: Arm,
    points: Points,
    advance: Advance = lambda *_: None,
    without: Collection[str] = (),
    source: str = "points.csv",
) -> StaticGap:
    """Name what is missing in the model of `arm` at these poses; `without` leaves effects out of the list."""
    advance("fitting the geometry", 0.0)
    parts = split(points)
    bare = fitted(arm, points, parts.known)
    floor = noise_floor(arm, points, bare.residual_m)
    tried = tuple(one for one in candidates(arm, points) if one.name.effect not in without)
    if not np.isfinite(floor.tip_m):
        floor = _from_the_richest(bare, parts, tried)
    advance("weighing effects", 0.3)
    decision, fit = _searched(arm, points, parts, tried, bare, floor)
    advance("looking for what is left", 0.6)
    verdict = _judged(points, parts, tried, bare, decision, fit, floor)
    advance("reporting", 0.8)
    fits = _stages(arm, points, parts, bare, verdict.kept)
    could = nameable(Linearised.around(bare.problem, fit.geometry_x, floor.tip_m), tried, parts.known)
    nominal = bare.problem.residuals(np.zeros(len(bare.x)))
    final = fits[-1][1]
    before, after = (_rms(residual, final.sure(parts.report)) for residual in (nominal, final.residual_m))
    ambiguous = decision.ambiguous if verdict.unknown is None else ()
    finding = GapFinding(
        arm=arm.name,
        data=(source,),
        noise_floor={"tip_m": floor.tip_m},
        gap_before=before / floor.tip_m,
        gap_after=after / floor.tip_m,
        before_si={"tip_m": before},
        after_si={"tip_m": after},
        effects=_named(fits, parts, floor, decision, nominal),
        ambiguous=ambiguous,
        unknown=verdict.unknown,
        nameable=could,
        next_experiment=next_experiment(ambiguous, verdict.unknown, could, "free" in points.setup),
    )
    stages = (("as it is", nominal), *((name, one.residual_m) for name, one in fits))
    return StaticGap(finding, points, parts, floor, stages, final)


def _judged(
    points: Points,
    parts: Split,
    tried: Sequence[Candidate],
    bare: Fitted,
    decision: Decision,
    fit: Fitted,
    floor: Floor,
) -> Judgement:
    """What of the decision is kept: not what a shape without a name would replace, nor what the remainder contradicts."""
    left = remainders(fit, parts.known, shapes(points), floor.tip_m)
    twins = _twins(bare, fit, parts, tried, decision, points, floor)
    sure_names = {tried[k].name for k in decision.accepted if k not in twins}
    accepted = [one for one in fit.chosen if one.name in sure_names]
    verdict = judge(accepted, decision.leader, bare, fit, left, parts.known, floor.tip_m)
    if verdict.unknown is not None or not twins:
        return verdict
    number, shape = next(iter(twins.items()))
    share = explained_share(bare, fit, parts.known, floor.tip_m)
    return Judgement(verdict.kept, Unknown(shape.words, tried[number].name, round(share, 3)))


def _from_the_richest(bare: Fitted, parts: Split, tried: Sequence[Candidate]) -> Floor:
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


def _searched(
    arm: Arm, points: Points, parts: Split, tried: Sequence[Candidate], bare: Fitted, floor: Floor
) -> tuple[Decision, Fitted]:
    """Decide around the geometry alone, refit with what was decided, and look again until it stays."""
    fit = bare
    for _ in range(LOOKS):
        around = Linearised.around(bare.problem, fit.geometry_x, floor.tip_m)
        evidence = around.evidence(tried, parts.known)
        decision = decide(evidence, tried)
        chosen = tuple(with_doubt(evidence, tried, decision.best, k) for k in decision.best.chosen)
        if [one.name for one in chosen] == [one.name for one in fit.chosen]:
            break
        fit = fitted(arm, points, parts.known, chosen)
    return decision, fit


def _twins(
    bare: Fitted,
    fit: Fitted,
    parts: Split,
    tried: Sequence[Candidate],
    decision: Decision,
    points: Points,
    floor: Floor,
) -> dict[int, Shape]:
    """Accepted names that a shape without a name would replace."""
    if not decision.accepted:
        return {}
    around = Linearised.around(bare.problem, fit.geometry_x, floor.tip_m)
    some = shapes(points)
    columns = [around.columns(c.slope_rad) * c.size for c in tried]
    columns += [around.columns(shape.slope_rad) for shape in some]
    ends = np.cumsum([column.shape[1] for column in columns])
    at = [list(range(end - column.shape[1], end)) for column, end in zip(columns, ends, strict=True)]
    keep = np.repeat(parts.known, 3)
    evidence = Evidence.of(around.base[keep], np.concatenate(columns, axis=1)[keep], around.y[keep])
    return doubles(evidence, at[: len(tried)], at[len(tried) :], tried, decision.best.chosen, some)


def _stages(
    arm: Arm, points: Points, parts: Split, bare: Fitted, kept: Sequence[Candidate]
) -> list[tuple[str, Fitted]]:
    """Geometry, then one effect more at a time."""
    growing = (kept[: count + 1] for count in range(len(kept)))
    return [
        ("link geometry", bare),
        *((str(some[-1].name), fitted(arm, points, parts.known, some)) for some in growing),
    ]


def _named(
    fits: Sequence[tuple[str, Fitted]], parts: Split, floor: Floor, decision: Decision, nominal: Array
) -> tuple[NamedEffect, ...]:
    """The geometry, where the nominal one does not do, and every effect that was kept."""
    final = fits[-1][1]
    found = []
    gained = (_rms(nominal, parts.known) ** 2 - fits[0][1].rms_m(parts.known) ** 2) / floor.tip_m**2
    if gained * 3 * parts.known.sum() > GEOMETRY_PAYS:
        gap = fits[0][1].rms_m(parts.report) / floor.tip_m
        found.append(NamedEffect(EffectName("link_geometry"), _geometry(final, parts, floor), gap))
    values = parameters_of(final, parts.known, floor.tip_m)
    for (_, fit), one, parameters in zip(fits[1:], final.chosen, values, strict=True):
        gap = fit.rms_m(parts.report) / floor.tip_m
        found.append(NamedEffect(one.name, parameters, gap, {"margin": decision.margin}))
    return tuple(found)


def _geometry(final: Fitted, parts: Split, floor: Floor) -> dict[str, tuple[float, float]]:
    """The DH deviations under the names of formats.md, with standard deviations; a prior of their bound included."""
    _, jacobian = final.problem.residuals_and_jacobian(final.x)
    base = jacobian[parts.known].reshape(-1, len(final.x)) / floor.tip_m
    covariance = np.linalg.inv(base.T @ base + np.eye(len(final.x)))
    scale = np.array([parameter.scale for parameter in final.problem.parameters])
    sd = np.sqrt(np.diag(covariance)) * scale
    deviation = (final.solution.dh - final.problem.model.nominal_dh).ravel()
    return {
        f"link{k // 4 + 1}_{KINDS[k % 4]}": (float(deviation[k]), float(sd[k])) for k in range(len(deviation))
    }


def _rms(residual_m: Array, rows: Mask) -> float:
    return float(np.sqrt(np.mean(residual_m[rows] ** 2)))
