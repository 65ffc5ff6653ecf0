"""From the weighed sets to the answer: totals with their standard deviations, the gap stage by stage, and what is left."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.assembly import BASE, Choice, problem_of
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, Mask
from calib.gap.effects.catalogue import is_load
from calib.gap.effects.frame import FRAME
from calib.gap.effects.pose_scene import load_of
from calib.gap.finding import (
    GEOMETRY,
    EffectName,
    GapFinding,
    NamedEffect,
    Parameters,
    Remainder,
    Unknown,
)
from calib.gap.model_update import updated_arm
from calib.gap.poses.as_written import left_as_written, without_unnamed
from calib.gap.poses.cautions import about_fit
from calib.gap.poses.currents import Currents
from calib.gap.poses.drawn_laws import drawn_laws
from calib.gap.poses.experiments import next_experiment, open_questions
from calib.gap.poses.floor import Floor, noise_floor
from calib.gap.poses.held_out import holds_on_others, shows_in_others
from calib.gap.poses.outcome import StaticGap
from calib.gap.poses.recordings import Split
from calib.gap.poses.state import Around
from calib.gap.posterior.constants import GEOMETRY_PAYS, LAW_MOST, UNMEASURED, UNSURE, CHANGED_sd
from calib.gap.posterior.decide import Decision, left_with, share_of
from calib.gap.posterior.nameable import nameable
from calib.gap.posterior.parameters import Estimated, estimated
from calib.gap.posterior.search import Weighed
from calib.gap.posterior.term import Block, Key, Term
from calib.points.points import Points
from control.model.arm import Arm, Effect
from control.model.effects import linear_values

KINDS = ("d_m", "theta_rad", "L_m", "alpha_rad")


@dataclass(frozen=True, slots=True)
class Looked:
    """What the posterior looks at: the arm, without and with only the loads of the effects that are looked for, the poses and
    their split, the geometry fitted alone, the noise floor, the holding currents, and the outliers (m,).
    """

    arm: Arm
    bare_arm: Arm
    loaded: Arm
    points: Points
    parts: Split
    problem: ArmProblem
    x: Array
    floor: Floor
    currents: Currents | None
    out: Mask

    def refloored(self, residual_m: Array) -> Looked:
        """With the noise as repeats show it beside residual_m (m, 3) of a model: a joint that drifts parts repeats, too."""
        found = noise_floor(self.arm, self.points, residual_m, self.out)
        return dataclasses.replace(self, floor=found) if math.isfinite(found.tip_m) else self


@dataclass(frozen=True, slots=True)
class Named:
    """A name that is given, its estimate, and the residual (m, 3) with it and all names before it in the model."""

    name: EffectName
    found: Estimated
    residual_m: Array


def answered(
    looked: Looked, around: Around, decision: Decision, warnings: tuple[str, ...], source: str
) -> StaticGap:
    """The finding of a decision, with what its report draws."""
    best, points, parts = decision.best, looked.points, looked.parts
    decision, estimates, reasons = _borne_out(looked, around, decision)
    residual = around.fitted(best)[1]
    x, _ = around.fitted(without_unnamed(around, best, decision.names))
    floor = looked.refloored(residual).floor
    if floor.doubt >= UNMEASURED:
        floor = dataclasses.replace(floor, tip_m=floor.tip_m * best.kappa)
    changed = [name for name in decision.names if _is_new(looked.arm, name, estimates[name])]
    order = _ordered(around, best, changed)
    geometry, stages = _stages(around, best, decision, order)
    named = [Named(name, estimates[name], left) for name, left in zip(order, stages, strict=True)]
    nominal_problem = problem_of(looked.arm, points)
    nominal = nominal_problem.residuals(np.zeros(len(nominal_problem.parameters)))
    sure = parts.report & ~_unsure(around, [one.found for one in named])
    effects = [_named(around, decision, one, floor, sure) for one in named]
    freed = 3 * parts.known.sum() * (rms(nominal, parts.known) ** 2 - rms(geometry, parts.known) ** 2)
    if freed > GEOMETRY_PAYS * floor.tip_m**2:
        gap = rms(geometry, sure) / floor.tip_m
        effects.insert(0, NamedEffect(EffectName(GEOMETRY), _geometry(around, best, x), gap))
    sizes = rms(nominal, sure), rms(stages[-1] if stages else geometry, sure)
    finding = _finding(looked, around, decision, reasons, tuple(effects), floor, sizes, source)
    problem = around.state.posed()
    written = left_as_written(updated_arm(looked.arm, finding, problem.solution(x).dh), points, parts.known)
    finding = dataclasses.replace(finding, gap_as_written=rms(written, sure) / floor.tip_m)
    warnings += tuple(about_fit(looked.arm, problem, x, floor, around.noise_m * best.kappa))
    grown = [(str(one.name), one.residual_m) for one in named]
    return StaticGap(
        finding, points, parts, floor, (("nominal", nominal), ("link geometry", geometry), *grown), problem, x, warnings,
        looked.out, load_of(looked.arm, points), drawn_laws(around, best, order, residual),
    )  # fmt: skip


def _finding(
    looked: Looked, around: Around, decision: Decision, reasons: Mapping[EffectName, str],
    effects: tuple[NamedEffect, ...], floor: Floor, sizes: tuple[float, float], source: str,
) -> GapFinding:  # fmt: skip
    """`sizes`: root mean square of the tip [m] at the poses that report, before and after."""
    before, after = sizes
    remainder, unknown = _remainder(around, decision, reasons), _unknown(around, decision, reasons)
    could = nameable(around.evidence)
    has_free = "free" in looked.points.setup
    return GapFinding(
        arm=looked.arm.name, data=(source,), noise_floor={"tip_m": floor.tip_m}, gap_before=before / floor.tip_m,
        gap_after=after / floor.tip_m, before_si={"tip_m": before}, after_si={"tip_m": after}, effects=effects,
        ambiguous=decision.ambiguous, unknown=unknown, nameable=could,
        next_experiment=next_experiment(decision.ambiguous, unknown, could, has_free),
        is_held_out=looked.parts.is_divided, remainder=remainder,
        open_questions=open_questions(decision.ambiguous, remainder),
    )  # fmt: skip


def rms(residual_m: Array, rows: Mask) -> float:
    """Of one axis, over the poses of a mask (m,)."""
    return float(np.sqrt(np.mean(residual_m[rows] ** 2)))


def _borne_out(
    looked: Looked, around: Around, decision: Decision
) -> tuple[Decision, Mapping[EffectName, Estimated], Mapping[EffectName, str]]:
    """Without names that the data do not bear out, which become remainders, each with its reason; without blocks that no
    pose that was left out shows.
    """
    best = decision.best
    estimates = {name: estimated(around.evidence, best, name) for name in decision.names}
    kept = [group for group in decision.remainders if _shows_elsewhere(around, best, group)]
    nameless = [k for k, _ in best.members if any(around.terms[k].key in group for group in kept)]
    reasons = {
        name: why
        for name, own in estimates.items()
        if (why := _why_not(around, best, name, own, _is_looked_for(looked, name), nameless))
    }
    names = tuple(name for name in decision.names if name not in reasons)
    remainders = (*kept, *((name,) for name in reasons))
    return dataclasses.replace(decision, names=names, remainders=remainders), estimates, reasons


def _is_looked_for(looked: Looked, name: EffectName) -> bool:
    """Whether it is in every set: what the file has, and the frame of tips that nothing ties to the arm."""
    is_frame = name.effect == FRAME and BASE in Choice().for_points(looked.arm, looked.points).freed
    return is_frame or _known(looked.arm, name) is not None


def _why_not(
    around: Around, best: Weighed, name: EffectName, own: Estimated, is_known: bool, nameless: Sequence[int]
) -> str:
    """Why a name is not given; empty if it is. What the arm's file has is a total, and may be nothing."""
    if _is_nothing(own):
        return (
            ""
            if is_known or name.effect == FRAME
            else f"{name} acts, but these poses do not tell how large it is"
        )
    if own.departure > LAW_MOST:
        return f"{name} departs too far from its law"
    if not holds_on_others(around, best, name):
        return f"{name} does not hold on poses that it was not fitted to"
    if not is_known and _may_be_error_of(around, best, name, nameless):
        return f"{name} is no larger than the error of what has no name"
    return ""


def _may_be_error_of(around: Around, best: Weighed, name: EffectName, nameless: Sequence[int]) -> bool:
    """Whether blocks without a name explain so much more than a name that their error would pass for it.

    A block is no law: what it stands for differs from it by at least as much as the roughest part from its law.
    """
    own = next(k for k, _ in best.members if around.terms[k].key == name)
    if not nameless or around.terms[own].slope_Nm is not None:  # the currents speak for a torque
        return False
    explained = share_of(around.evidence, best, [own])
    return explained < LAW_MOST**2 * share_of(around.evidence, best, nameless)


def _is_nothing(own: Estimated) -> bool:
    """Whether the size that was found may as well be none."""
    return not own.differs_from(np.zeros_like(own.value))


def _shows_elsewhere(around: Around, best: Weighed, group: tuple[Key, ...]) -> bool:
    """Whether the blocks of a remainder that are in the best set help poses that they were not fitted to."""
    present = {around.terms[k].key for k, _ in best.members}
    blocks = [key for key in group if isinstance(key, Block) and key in present]
    return not blocks or any(shows_in_others(around, best, key) for key in blocks)


def _known(arm: Arm, name: EffectName) -> Effect | None:
    """What the arm's file has of this name."""
    return next((one for one in arm.effects if (one.effect, one.joint) == (name.effect, name.joint)), None)


def _is_new(arm: Arm, name: EffectName, found: Estimated) -> bool:
    """Whether the total differs from what the arm's file has."""
    known = _known(arm, name)
    if known is None:
        return not _is_nothing(found)  # the frame of a camera is always looked for
    before = () if is_load(name.effect) else linear_values(name.effect, known.parameters)
    if before:
        return found.differs_from(np.array(before))
    return any(
        key not in known.parameters or not abs(value - known.parameters[key]) <= CHANGED_sd * sd
        for key, (value, sd) in found.parameters.items()
    )


def _ordered(around: Around, best: Weighed, names: Sequence[EffectName]) -> list[EffectName]:
    """By the share that each explains."""
    numbers = {around.terms[k].key: k for k, _ in best.members}
    present = [name for name in names if name in numbers]
    return sorted(present, key=lambda name: -share_of(around.evidence, best, [numbers[name]]))


def _unsure(around: Around, found: Sequence[Estimated]) -> Mask:
    """Poses (m,) in which the flank of a named play is uncertain, within a variant or between them: they say nothing of what
    is left.
    """
    unsure = np.zeros(len(around.points), dtype=bool)
    for one in found:
        terms = [around.terms[number] for number, _ in one.variants]
        weight = np.array([share for _, share in one.variants])
        if terms[0].doubt is None:
            continue
        flank = np.array([_flank(term) for term in terms])
        doubt = np.array([np.zeros(len(unsure)) if term.doubt is None else term.doubt for term in terms])
        unsure |= weight @ (doubt + (flank - weight @ flank) ** 2) > UNSURE
    return unsure if unsure[around.rows].mean() < 0.5 else np.zeros_like(unsure)


def _flank(term: Term) -> Array:
    """What a play of 1 rad does to its joint, (m,)."""
    return np.zeros(0) if term.slope_rad is None else np.asarray(term.slope_rad[0].sum(axis=1) / term.size)


def _stages(
    around: Around, best: Weighed, decision: Decision, order: Sequence[EffectName]
) -> tuple[Array, list[Array]]:
    """Residuals (m, 3) with the geometry and what the file has, then with one name more at a time; refitted, no blocks."""
    keys = {one: around.terms[one[0]].key for one in best.members}
    unchanged = [name for name in decision.names if name not in order]
    base = [one for one, key in keys.items() if key in unchanged]
    grown = [
        [*base, *(one for one, key in keys.items() if key in order[:count])]
        for count in range(len(order) + 1)
    ]
    first, *others = (around.fitted(dataclasses.replace(best, members=tuple(some)))[1] for some in grown)
    return first, others


def _named(around: Around, decision: Decision, one: Named, floor: Floor, sure: Mask) -> NamedEffect:
    numbers = {around.terms[k].key: k for k, _ in decision.best.members}
    return NamedEffect(
        one.name, _parameters(one), rms(one.residual_m, sure) / floor.tip_m,
        probability=decision.probability[one.name],
        share=share_of(around.evidence, decision.best, [numbers[one.name]]),
        departure=one.found.departure, variable=one.found.variable, is_nothing=_is_nothing(one.found),
    )  # fmt: skip


def _parameters(one: Named) -> Parameters:
    """As estimated; of an effect that is not there none: a stiffness is then anything from some size on."""
    return {} if _is_nothing(one.found) else one.found.parameters


def _geometry(around: Around, best: Weighed, x: Array) -> Parameters:
    """The DH deviations under the names of docs/formats.md, with standard deviations."""
    problem = around.state.problem
    still = np.zeros(len(around.linear.y))
    _, covariance = around.linear.geometry(around.rows, around.noise_m * best.kappa, still)
    sd = np.sqrt(np.diag(covariance)) * np.array([one.scale for one in problem.parameters])
    deviation = (problem.solution(x).dh - problem.model.nominal_dh).ravel()
    return {
        f"link{k // 4 + 1}_{KINDS[k % 4]}": (float(deviation[k]), float(sd[k])) for k in range(len(deviation))
    }


def _remainder(
    around: Around, decision: Decision, reasons: Mapping[EffectName, str]
) -> tuple[Remainder, ...]:
    """What is left without one name, the largest first: blocks, sets that are ambiguous, laws that do not hold."""
    best = decision.best
    numbers = {around.terms[k].key: k for k, _ in best.members}
    found = []
    for group in (*decision.ambiguous, *decision.remainders):
        own = [numbers[key] for key in group if key in numbers]
        if not own:
            continue
        move = around.moved_m(best, own)
        size = {"tip_m": rms(move, around.rows)} if move.any() else {}
        blocks = [around.terms[k].words for k in own if not around.terms[k].is_name]
        names = " or ".join(str(key) for key in group if isinstance(key, EffectName))
        unnamed = blocks[0] if blocks else "; ".join(why for key, why in reasons.items() if key in group)
        where = names if group in decision.ambiguous else unnamed
        found.append(Remainder(where, share_of(around.evidence, best, own), size))
    return tuple(sorted(found, key=lambda one: -one.share))


def _unknown(around: Around, decision: Decision, reasons: Mapping[EffectName, str]) -> Unknown | None:
    """The remainder without a name that explains most, if there is one."""
    if not decision.remainders:
        return None
    best, terms = decision.best, around.terms
    numbers = {terms[k].key: k for k, _ in best.members}
    blocks = [key for group in decision.remainders for key in group if isinstance(key, Block)]
    ranked = sorted(
        (share_of(around.evidence, best, [numbers[key]]), terms[numbers[key]].words)
        for key in blocks
        if key in numbers
    )
    names = [key for group in decision.remainders for key in group if isinstance(key, EffectName)]
    if ranked:
        where = ranked[-1][1]
    elif blocks:
        where = terms[around.evidence.of_key[blocks[0]][0]].words
    else:
        where = reasons[names[0]]
    return Unknown(where, *_nearest(around, decision))


def _nearest(around: Around, decision: Decision) -> tuple[EffectName | None, float]:
    """The effect that is not named and explains most beside the names, and its share of what these leave."""
    evidence, best = around.evidence, decision.best
    named = tuple(one for one in best.members if around.terms[one[0]].key in decision.names)
    added = evidence.added(named, best.kappa)
    others = [k for k, one in enumerate(around.terms) if one.is_name and one.key not in decision.names]
    if not others:
        return None, 0.0
    top = max(others, key=lambda k: float(added.log[k]))
    key = around.terms[top].key
    alone, with_it = (
        left_with(evidence, dataclasses.replace(best, members=some))
        for some in (named, (*named, (top, int(added.best[top]))))
    )
    excess = alone - left_with(evidence, best)
    share = min(1.0, max(0.0, (alone - with_it) / excess)) if excess > 0.0 else 0.0
    return (key if isinstance(key, EffectName) else None), round(share, 3)
