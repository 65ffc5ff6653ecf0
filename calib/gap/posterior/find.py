"""Static poses from end to end by one posterior: names, sets, remainders, and the gap on recordings kept apart."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.assembly import problem_of
from calib.arm_problem.joint_laws import LAWS
from calib.arrays import Array, Mask
from calib.gap.finding import EffectName, GapFinding, NamedEffect, Unknown
from calib.gap.poses.candidates import candidates
from calib.gap.poses.currents import Currents, holding_currents
from calib.gap.poses.floor import Floor, noise_floor
from calib.gap.poses.generic import load_of
from calib.gap.poses.model import Fitted, fitted
from calib.gap.posterior.constants import DEPARTURES, FLOOR_DOUBT
from calib.gap.posterior.decide import Decision, decide, share_of
from calib.gap.posterior.nameable import nameable
from calib.gap.posterior.parameters import Estimated, estimated
from calib.gap.posterior.recordings import parted
from calib.gap.posterior.search import Search, Weighed
from calib.gap.posterior.state import Around, State
from calib.gap.posterior.term import Block, Key, Term
from calib.gap.static.cautions import about_data, about_outliers, cleaned, require_posed
from calib.gap.static.experiments import next_experiment
from calib.gap.static.find import StaticGap, _from_the_richest, _scatter_m
from calib.gap.static.linearised import Linearised
from calib.gap.static.naming import KINDS, rms
from calib.gap.static.outlying import outlying
from calib.gap.static.split import Split
from calib.points.points import Points
from control.model.arm import Arm

LOOKS = 3  # linearisations, at most
TOTALS = (*LAWS, "link_flexure")  # effects of the file that are looked for as a whole
CHANGED_sd = 3.0
GEOMETRY_PAYS = 40.0
LAW_MOST = 2.0 * max(
    DEPARTURES
)  # what departs more than two standard deviations of the roughest part has another law
UNSURE = 0.025  # variance of the play over its width squared: one pose in twenty on the other flank
UNTOLD = 1.0  # doubt of a floor that nothing measured
FROM_THE_FIT = "what the best explanation leaves: there are no repeats and no camera's noise, what is left passes for noise"

Advance = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class Prepared:
    """What the posterior looks at: poses, their split, the arm without the effects looked for, floor, currents."""

    arm: Arm
    bare_arm: Arm
    points: Points
    parts: Split
    bare: Fitted
    floor: Floor
    currents: Currents | None
    out: Mask


def find(
    arm: Arm,
    points: Points,
    advance: Advance = lambda *_: None,
    without: Collection[str] = (),
    source: str = "points.csv",
) -> StaticGap:
    """Name what is missing in the model of `arm` at these poses; `without` leaves effects out of the list.

    UnusablePointsError for points of which nothing can be said.
    """
    advance("reading the poses", 0.0)
    warnings = [*require_posed(arm, points), *about_data(arm, points)]
    advance("fitting the geometry", 0.05)
    ready = _prepared(arm, cleaned(points), without)
    warnings += about_outliers(ready.points, ready.out)
    around, decision = _searched(ready, without, advance)
    advance("reporting", 0.85)
    return _reported(ready, around, decision, tuple(warnings), source)


def _prepared(arm: Arm, points: Points, without: Collection[str]) -> Prepared:
    bare_arm = dataclasses.replace(arm, effects=tuple(e for e in arm.effects if e.effect not in TOTALS))
    tried = tuple(one for one in candidates(bare_arm, points) if one.name.effect not in without)
    parts = parted(points)
    bare = fitted(bare_arm, points, parts.known)
    out = outlying(Linearised.around(bare.problem, bare.x, _scatter_m(bare_arm, points, bare)), tried)
    if out.any():
        parts = parts.without(out)
        bare = fitted(bare_arm, points, parts.known)
    floor = noise_floor(arm, points, bare.residual_m, out)
    if not np.isfinite(floor.tip_m):
        floor = dataclasses.replace(_from_the_richest(bare, parts, tried), doubt=UNTOLD)
    currents = holding_currents(bare_arm, points, tried)
    return Prepared(arm, bare_arm, points, parts, bare, floor, currents, np.asarray(out))


def _searched(ready: Prepared, without: Collection[str], advance: Advance) -> tuple[Around, Decision]:
    """Look, linearise anew around what was found, and look again until it stays."""
    forced = [EffectName(e.effect, e.joint) for e in ready.arm.effects if e.effect in TOTALS]
    state = State.bare(ready.bare.problem, ready.bare.x, ready.bare_arm)
    noise = ready.floor.tip_m, max(ready.floor.doubt, FLOOR_DOUBT)
    known: list[frozenset[Key]] = []
    blocks: tuple[Term, ...] = ()
    for look in range(LOOKS):
        advance("weighing effects", 0.2 + 0.2 * look)
        around = Around.of(
            state, ready.bare_arm, ready.points, ready.parts.known, noise, ready.currents, without, blocks
        )
        blocks = around.blocks
        search = Search(around.evidence, forced)
        found = search.run(known)
        decision = decide(around.evidence, found)
        keys = search.keys(decision.best.members)
        if (look and keys == known[0]) or not keys:
            break
        names = frozenset(key for key in keys if isinstance(key, EffectName))
        known = [keys, names]
        if look < LOOKS - 1:
            state = around.next_state(decision.best)
    return around, decision


def _reported(
    ready: Prepared, around: Around, decision: Decision, warnings: tuple[str, ...], source: str
) -> StaticGap:
    evidence, best, parts, floor = around.evidence, decision.best, ready.parts, ready.floor
    if floor.doubt >= UNTOLD:
        floor = dataclasses.replace(floor, tip_m=floor.tip_m * best.kappa, source=FROM_THE_FIT)
        ready = dataclasses.replace(ready, floor=floor)
    estimates = {key: estimated(evidence, best, key) for key in decision.names}
    decision = _without_other_laws(decision, estimates)
    told = [name for name in decision.names if _is_new(ready.arm, name, estimates[name])]
    nominal_problem = problem_of(ready.arm, ready.points)
    nominal = nominal_problem.residuals(np.zeros(len(nominal_problem.parameters)))
    kept = _ordered(around, best, told)
    stages = _stages(around, best, decision, kept)
    sure = parts.report & ~_unsure(around, best, kept)
    final = stages[-1][1]
    x, _ = around.fitted(best)
    effects = _named(ready, around, decision, estimates, kept, stages, nominal, x, sure)
    unknown = _unknown(around, decision)
    before, after = (rms(residual, sure) for residual in (nominal, final))
    could = nameable(evidence)
    finding = GapFinding(
        arm=ready.arm.name, data=(source,), noise_floor={"tip_m": floor.tip_m}, gap_before=before / floor.tip_m,
        gap_after=after / floor.tip_m, before_si={"tip_m": before}, after_si={"tip_m": after}, effects=effects,
        ambiguous=decision.ambiguous, unknown=unknown, nameable=could,
        next_experiment=next_experiment(decision.ambiguous, unknown, could, "free" in ready.points.setup),
        is_held_out=parts.is_divided,
    )  # fmt: skip
    fit = Fitted(around.state.posed(), x, (), final)
    drawn = (("as it is", nominal), *stages)
    out = ready.out
    return StaticGap(
        finding, ready.points, parts, floor, drawn, fit, warnings, out, load_of(ready.arm, ready.points)
    )


def _without_other_laws(decision: Decision, estimates: Mapping[EffectName, Estimated]) -> Decision:
    """Names whose law departs too far from the textbook's, or hardly acts, are remainders and no names."""
    bent = [
        name
        for name, own in estimates.items()
        if own.departure > LAW_MOST or float(np.linalg.norm(own.value / own.sd)) < CHANGED_sd
    ]
    return dataclasses.replace(
        decision,
        names=tuple(name for name in decision.names if name not in bent),
        remainders=(*decision.remainders, *((name,) for name in bent)),
    )


def _is_new(arm: Arm, name: EffectName, found: Estimated) -> bool:
    """Whether the total differs from what the arm's file has."""
    for one in arm.effects:
        if (one.effect, one.joint) == (name.effect, name.joint) and one.effect in TOTALS:
            known = np.array(
                LAWS[one.effect].linear(one.parameters)
                if one.effect in LAWS
                else [1.0 / one.parameters["EI_Nm2"]]
            )
            return bool(np.any(np.abs(found.value - known) > CHANGED_sd * found.sd))
    return True


def _ordered(around: Around, best: Weighed, names: list[EffectName]) -> list[EffectName]:
    """By the share that each explains."""
    evidence = around.evidence
    numbers = {evidence.terms[k].key: k for k, _ in best.members}
    present = [name for name in names if name in numbers]
    return sorted(present, key=lambda name: -share_of(evidence, best, [numbers[name]]))


def _unsure(around: Around, best: Weighed, names: list[EffectName]) -> Mask:
    """Poses (m,) in which nobody can tell the flank of a named play: they tell nothing of what is left."""
    found = np.zeros(len(around.points), dtype=bool)
    for number, _ in best.members:
        one = around.terms[number]
        if one.doubt is not None and one.key in names:
            found |= one.doubt > UNSURE
    return found if found[around.rows].mean() < 0.5 else np.zeros_like(found)


def _stages(
    around: Around, best: Weighed, decision: Decision, kept: list[EffectName]
) -> tuple[tuple[str, Array], ...]:
    """Residuals (m, 3) with the geometry alone, then with one name more at a time; all refitted, nothing without a name."""
    terms = around.terms
    forced = [one for one in best.members if isinstance(terms[one[0]].key, EffectName) and terms[one[0]].key not in kept
              and terms[one[0]].key in decision.names]  # fmt: skip
    found = [("link geometry", _residual(around, best, forced))]
    for count in range(1, len(kept) + 1):
        some = [one for one in best.members if terms[one[0]].key in kept[:count]]
        found.append((str(kept[count - 1]), _residual(around, best, [*forced, *some])))
    return tuple(found)


def _residual(around: Around, best: Weighed, members: list[tuple[int, int]]) -> Array:
    _, left = around.fitted(dataclasses.replace(best, members=tuple(members)))
    return left


def _named(
    ready: Prepared, around: Around, decision: Decision, estimates: dict[EffectName, Estimated], kept: list[EffectName],
    stages: tuple[tuple[str, Array], ...], nominal: Array, x: Array, sure: Mask,
) -> tuple[NamedEffect, ...]:  # fmt: skip
    parts, floor, evidence = ready.parts, ready.floor, around.evidence
    found = []
    freed = (np.sum(nominal[parts.known] ** 2) - np.sum(stages[0][1][parts.known] ** 2)) / floor.tip_m**2
    if freed > GEOMETRY_PAYS:
        gap = rms(stages[0][1], sure) / floor.tip_m
        found.append(NamedEffect(EffectName("link_geometry"), _geometry(around, decision.best, x), gap))
    numbers = {evidence.terms[k].key: k for k, _ in decision.best.members}
    for name, (_, residual) in zip(kept, stages[1:], strict=True):
        own = estimates[name]
        told = {
            "probability": decision.probability[name],
            "share": share_of(evidence, decision.best, [numbers[name]]),
            "law_departure": own.departure,
        }
        found.append(NamedEffect(name, own.parameters, rms(residual, sure) / floor.tip_m, told))
    return tuple(found)


def _geometry(around: Around, best: Weighed, x: Array) -> dict[str, tuple[float, float]]:
    """The DH deviations under the names of formats.md, with standard deviations."""
    problem = around.state.problem
    _, covariance = around.linear.geometry(
        around.rows, around.noise_m * best.kappa, np.zeros(len(around.linear.y))
    )
    sd = np.sqrt(np.diag(covariance)) * np.array([one.scale for one in problem.parameters])
    deviation = (problem.solution(x).dh - problem.model.nominal_dh).ravel()
    return {
        f"link{k // 4 + 1}_{KINDS[k % 4]}": (float(deviation[k]), float(sd[k])) for k in range(len(deviation))
    }


def _unknown(around: Around, decision: Decision) -> Unknown | None:
    """The remainder that explains most, if there is one."""
    if not decision.remainders:
        return None
    terms, best = around.terms, decision.best
    numbers = {terms[k].key: k for k, _ in best.members}
    blocks = [key for group in decision.remainders for key in group if isinstance(key, Block)]
    ranked = sorted(
        (share_of(around.evidence, best, [numbers[key]]), terms[numbers[key]].words)
        for key in blocks
        if key in numbers
    )
    names = [key for group in decision.remainders for key in group if isinstance(key, EffectName)]
    others = sorted(
        ((p, key) for key, p in decision.probability.items() if isinstance(key, EffectName)),
        key=lambda one: -one[0],
    )
    if ranked:
        where = ranked[-1][1]
    elif blocks:
        where = terms[around.evidence.of_key[blocks[0]][0]].words
    else:
        where = f"what {names[0]} would explain departs too far from its law"
    nearest = names[0] if names else others[0][1] if others else None
    shares = [share for share, _ in ranked if math.isfinite(share)]
    return Unknown(where, nearest, round(max(0.0, 1.0 - sum(shares)), 3))
