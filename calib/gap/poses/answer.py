"""From the weighed sets to the answer: totals with their standard deviations, the gap stage by stage, and what is left."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.assembly import BASE, Choice, problem_of
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
)
from calib.gap.model_update import updated_arm
from calib.gap.poses.as_written import left_as_written, without_unnamed
from calib.gap.poses.cautions import about_fit
from calib.gap.poses.currents import Currents
from calib.gap.poses.drawn_laws import drawn_laws
from calib.gap.poses.experiments import next_experiment, open_questions
from calib.gap.poses.floor import Floor, noise_floor
from calib.gap.poses.held_out import holds_on_others, shows_in_others
from calib.gap.poses.measured import Fit, Left
from calib.gap.poses.outcome import StaticGap
from calib.gap.poses.recordings import Split
from calib.gap.poses.remainder import remainders, unknown_part
from calib.gap.poses.state import Around
from calib.gap.posterior.constants import GEOMETRY_PAYS, LAW_MOST, UNMEASURED, UNSURE, CHANGED_sd
from calib.gap.posterior.decide import Decision, share_of
from calib.gap.posterior.nameable import ODDS, nameable
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
    fit: Fit
    floor: Floor
    currents: Currents | None
    out: Mask

    def refloored(self, left: Left) -> Looked:
        """With the noise as repeats show it beside what a model leaves: a joint that drifts parts repeats, too."""
        found = noise_floor(self.arm, self.points, left, self.out)
        return dataclasses.replace(self, floor=found) if math.isfinite(found.tip_m) else self


@dataclass(frozen=True, slots=True)
class Named:
    """A name that is given, its estimate, and what is left with it and all names before it in the model."""

    name: EffectName
    found: Estimated
    left: Left


def answered(
    looked: Looked, around: Around, decision: Decision, warnings: tuple[str, ...], source: str
) -> StaticGap:
    """The finding of a decision, with what its report draws."""
    best, points, parts = decision.best, looked.points, looked.parts
    decision, estimates, reasons = _borne_out(looked, around, decision)
    left = around.fitted(best)[1]
    x, _ = around.fitted(without_unnamed(around, best, decision.names))
    floor = looked.refloored(left).floor
    if floor.doubt >= UNMEASURED:
        floor = dataclasses.replace(floor, tip_m=floor.tip_m * best.kappa)
    changed = [name for name in decision.names if _is_new(looked.arm, around, best, name, estimates[name])]
    order = _ordered(around, best, changed)
    geometry, stages = _stages(around, best, decision, order)
    named = [Named(name, estimates[name], left) for name, left in zip(order, stages, strict=True)]
    nominal = Fit.nominal(problem_of(looked.arm, points)).left()
    sure = parts.report & ~_unsure(around, [one.found for one in named])
    effects = [_named(around, decision, one, floor, sure) for one in named]
    freed = parts.known.sum() * (_square(nominal, floor, parts.known) - _square(geometry, floor, parts.known))
    if 3 * freed > GEOMETRY_PAYS:
        gap = geometry.times(floor.tip_m, floor.turn_rad, sure)
        effects.insert(0, NamedEffect(EffectName(GEOMETRY), _geometry(around, best, x), gap))
    ends = nominal, stages[-1] if stages else geometry
    finding = _finding(looked, around, decision, reasons, tuple(effects), floor, ends, sure, source)
    posed = around.state.posed()
    written = left_as_written(
        updated_arm(looked.arm.with_dh(posed.problem.solution(x).dh), finding), points, parts.known
    )
    as_written = written.times(floor.tip_m, floor.turn_rad, sure)
    finding = dataclasses.replace(finding, gap_as_written=as_written)
    warnings += tuple(about_fit(looked.arm, posed.problem, x, floor, around.noise_m * best.kappa))
    grown = [(str(one.name), one.left.tip_m) for one in named]
    return StaticGap(
        looked.arm, finding, points, parts, floor, (("nominal", nominal.tip_m), ("link geometry", geometry.tip_m), *grown),
        posed.problem, x, warnings, looked.out, load_of(looked.arm, points), drawn_laws(around, best, order, left.tip_m),
    )  # fmt: skip


def _square(left: Left, floor: Floor, rows: Mask) -> float:
    return left.times(floor.tip_m, floor.turn_rad, rows) ** 2


def _finding(
    looked: Looked, around: Around, decision: Decision, reasons: Mapping[EffectName, str],
    effects: tuple[NamedEffect, ...], floor: Floor, ends: tuple[Left, Left], sure: Mask, source: str,
) -> GapFinding:  # fmt: skip
    """`ends`: what is left before and after; `sure` (m,): the poses that report."""
    (before_si, after_si), (before, after) = zip(
        *((left.sizes(sure), left.times(floor.tip_m, floor.turn_rad, sure)) for left in ends), strict=True
    )
    noise = {channel: size for channel, size in floor.sizes.items() if channel in before_si}
    remainder, unknown = remainders(around, decision, reasons), unknown_part(around, decision, reasons)
    could = nameable(around.evidence)
    has_free = "free" in looked.points.setup
    return GapFinding(
        arm=looked.arm.name, data=(source,), noise_floor=noise, gap_before=before, gap_after=after,
        before_si={channel: before_si[channel] for channel in noise},
        after_si={channel: after_si[channel] for channel in noise}, effects=effects,
        ambiguous=decision.ambiguous, unknown=unknown, nameable=could,
        next_experiment=next_experiment(decision.ambiguous, unknown, could, has_free),
        is_held_out=looked.parts.is_divided, remainder=remainder,
        open_questions=open_questions(decision.ambiguous, remainder),
    )  # fmt: skip


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
    if not is_known and not holds_on_others(around, best, name):
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
    explained, *others = (share_of(around.evidence, best, [k]) for k in (own, *nameless))
    return explained < LAW_MOST**2 * sum(others)


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


def _is_new(arm: Arm, around: Around, best: Weighed, name: EffectName, found: Estimated) -> bool:
    """Whether the total differs from what the arm's file has.

    The frame of a camera is in every set, because nobody knows it to the noise: what it adds to the evidence says whether it is
    another than the file's.
    """
    known = _known(arm, name)
    if known is None:
        gains = {around.terms[k].key: gain for (k, _), gain in zip(best.members, best.gains, strict=True)}
        return gains[name] > ODDS and not _is_nothing(found)
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
) -> tuple[Left, list[Left]]:
    """What is left with the geometry and what the file has, then with one name more at a time; refitted, no blocks."""
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
        one.name, _parameters(one), one.left.times(floor.tip_m, floor.turn_rad, sure),
        probability=decision.probability[one.name],
        share=share_of(around.evidence, decision.best, [numbers[one.name]]),
        departure=one.found.departure, variable=one.found.variable, is_nothing=_is_nothing(one.found),
    )  # fmt: skip


def _parameters(one: Named) -> Parameters:
    """As estimated; of an effect that is not there none: a stiffness is then anything from some size on."""
    return {} if _is_nothing(one.found) else one.found.parameters


def _geometry(around: Around, best: Weighed, x: Array) -> Parameters:
    """The DH deviations under the names of docs/formats.md, with standard deviations."""
    problem = around.state.fit.problem
    still = np.zeros(len(around.linear.y))
    _, covariance = around.linear.geometry(around.rows, around.noise_m * best.kappa, still)
    sd = np.sqrt(np.diag(covariance))[: len(x)] * np.array([one.scale for one in problem.parameters])
    deviation = (problem.solution(x).dh - problem.model.nominal_dh).ravel()
    return {
        f"link{k // 4 + 1}_{KINDS[k % 4]}": (float(deviation[k]), float(sd[k])) for k in range(len(deviation))
    }
