"""From the weighed sets to the answer: totals with their standard deviations, the gap stage by stage, and what is left."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from calib.arm_problem.arm_model import dh_names
from calib.arm_problem.joint_effects import effect_key, made_effects
from calib.arrays import Mask
from calib.gap.effects.catalogue import SHARED, is_load
from calib.gap.effects.links import FRAME
from calib.gap.effects.record import load_of
from calib.gap.finding import (
    GEOMETRY,
    LINK_KEYS,
    EffectName,
    GapFinding,
    MapCheck,
    MeasuredMaps,
    NamedEffect,
    Parameters,
    is_possible,
    values_alone,
)
from calib.gap.poses.cautions import about_fit, about_flanks, about_orientations, about_outliers
from calib.gap.poses.file import File, follows, placed
from calib.gap.poses.floor import Floor
from calib.gap.poses.held_out import holds_on_others, shows_in_others
from calib.gap.poses.linear import Fit, Residuals
from calib.gap.poses.outcome import StaticGap, drawn_laws
from calib.gap.poses.remainder import next_experiment, open_questions, remainders, unknown_part
from calib.gap.poses.state import Linearised, Looked
from calib.gap.posterior.constants import GROWS, LAW_MOST, UNMEASURED, SURE_sd
from calib.gap.posterior.decide import Decision, Estimated, estimated, nameable, share_of
from calib.gap.posterior.evidence import Weighed
from calib.gap.posterior.term import Block, Key
from calib.gap.posterior.told import Told
from calib.gap.words import listed
from calib.points.points import FREE
from control.model.arm import Arm, Effect
from control.model.effects import linear_values


def answered(prepared: Looked, linearised: Linearised, decision: Decision) -> StaticGap:
    """The finding of a decision, with what its report draws; `prepared`: as it was before the search, which has another noise."""
    looked = linearised.looked
    best, points, parts = decision.best, looked.points, looked.parts
    warnings = [*looked.warnings, *about_orientations(points, looked.floor), *about_outliers(points, looked.out)]

    def told(withdrawn: Collection[Key] = ()) -> Told:
        return Told.by(linearised.evidence, best, SHARED, looked.told, withdrawn)

    others = looked.told
    # what the others lean to, but did not find themselves, is for these poses to bear out
    firmer: list[EffectName] = []
    if others is not None:
        firmer = [name for name in decision.names if name in others.found and others.knows_better(name, told())]
    decision, estimates, reasons = _borne_out(linearised, decision, firmer)
    residual = linearised.fitted(best)[1]
    floor = looked.refloored(residual).floor
    if floor.doubt >= UNMEASURED:
        floor = dataclasses.replace(floor, tip_m=floor.tip_m * best.kappa)
    changed = [name for name in decision.names if _is_new(looked.arm, name, estimates[name])]
    order = _ordered(linearised, best, changed)
    totals = {name: estimates[name] for name in order}
    decision, reasons = _with_sets_that_stand(linearised, decision, totals, firmer, reasons)
    beside = _open_members(linearised, decision)
    looked_at = dataclasses.replace(looked, floor=floor)
    nominal_fit = placed(looked.arm, points, parts.known)
    decision, files, reasons = _files(looked_at, nominal_fit, decision, totals, beside, firmer, reasons)
    order = [name for name in order if name in decision.names]
    last, nominal, residuals = files[-1], nominal_fit.residuals(), [file.fit.residuals() for file in files]
    gaps = [residual.times(floor.tip_m, floor.turn_rad, parts.report) for residual in residuals]
    effects = [
        _named(linearised, decision, last, name, estimates[name], gap)
        for name, gap in zip(order, gaps[1 : len(order) + 1], strict=True)
    ]
    if _pays(looked_at, nominal_fit, files[0]):
        effects.insert(0, NamedEffect(EffectName(GEOMETRY), _geometry(last), gaps[0]))
    finding = _finding(linearised, decision, reasons, tuple(effects), floor, (nominal, residuals[-1]))
    corrected = {correction.joint for correction in last.arm.maps}
    held = (*decision.names, *(name for name in beside if name.joint in corrected))
    departing = linearised.fitted(_named_alone(linearised, best, held))[1]
    finding = dataclasses.replace(
        finding, gap_explained=departing.times(floor.tip_m, floor.turn_rad, parts.report), maps=_maps(last, parts.report)
    )
    warnings += about_flanks(points, parts.report, last.between_flanks(points))
    warnings += about_fit(looked.arm, last.identification, floor, looked.floor.tip_m * best.kappa)
    steps = [*map(str, order), *map(str, last.arm.maps[:1])]
    grown = [(step, residual.tip_m) for step, residual in zip(steps, residuals[1:], strict=True)]
    return StaticGap(
        looked.arm,
        last.arm,
        finding,
        points,
        parts,
        floor,
        (("nominal", nominal.tip_m), ("link geometry", residuals[0].tip_m), *grown),
        last.fit.problem,
        last.fit.x,
        tuple(warnings),
        prepared,
        load_of(looked.arm, points),
        drawn_laws(linearised, best, order, residual.tip_m),
        told(reasons),
    )


def _files(
    looked: Looked,
    given: Fit,
    decision: Decision,
    estimates: Mapping[EffectName, Estimated],
    beside: Mapping[EffectName, Parameters],
    firmer: Collection[EffectName],
    reasons: Mapping[EffectName, str],
) -> tuple[Decision, list[File], Mapping[EffectName, str]]:
    """The file with the geometry alone, then with one name more at a time, last with the maps of what sets share, if these help
    poses that nobody fitted; without names that it cannot hold; `given`, the arm as it was, where it has no name and no map.
    `firmer`: names whose values other recordings know better.
    """
    named = {name: _acting(estimate) for name, estimate in estimates.items()}
    arm, points, rows, keys = looked.arm, looked.points, looked.parts.known, list(named)

    def fewer(why: Mapping[EffectName, str]) -> tuple[Decision, list[File], Mapping[EffectName, str]]:
        names = tuple(name for name in decision.names if name not in why)
        remainders = (*decision.remainders, *((name,) for name in why))
        kept = {name: estimate for name, estimate in estimates.items() if name not in why}
        less = dataclasses.replace(decision, names=names, remainders=remainders)
        return _files(looked, given, less, kept, beside, firmer, {**reasons, **why})

    def without(name: EffectName) -> File:
        return File.of(arm, points, rows, {key: value for key, value in named.items() if key != name}, beside, firmer)

    def left(file: File) -> float:
        return _square(file.fit.residuals(), looked.floor, looked.parts.report)

    last = File.of(arm, points, rows, named, beside, firmer)
    why = {name: f"{name} was identified with impossible values" for name in keys if named[name] and not last.has(name)}
    if not why:
        sought = (name for name in keys if named[name] and name not in firmer and _known(arm, name) is None)
        sure = {name: last.sureness(name, estimates[name]) for name in sought}
        if least := min((name for name in sure if sure[name] < 1.0), key=lambda name: sure[name], default=None):
            why = {least: f"{least} may as well be none, identified with what else is named"}
    if why:
        return fewer(why)
    if last.unshared is not None:
        last = min(last.unshared, last, key=left)
    if keys and left(last) > (1.0 + GROWS) * _square(given.residuals(), looked.floor, looked.parts.report):
        # no file that predicts worse than the arm as it was given: without the name that it is best without
        worst = min(keys, key=lambda name: left(without(name)))
        return fewer({worst: f"{worst} as identified predicts other poses worse than the arm as it was given"})
    if not keys and not last.arm.maps:
        # What has no name does not stand in the file: a geometry that gains no more than by chance is one fitted to noise.
        return decision, [last if _pays(looked, given, last) else dataclasses.replace(last, arm=arm, fit=given)], reasons
    files = [
        File.of(arm, points, rows, {key: named[key] for key in keys[:count]}, {}, firmer, False)
        for count in range(len(keys) + bool(last.arm.maps))
    ]
    return decision, [*files, last], reasons


def _with_sets_that_stand(
    linearised: Linearised,
    decision: Decision,
    estimates: Mapping[EffectName, Estimated],
    firmer: Collection[EffectName],
    reasons: Mapping[EffectName, str],
) -> tuple[Decision, Mapping[EffectName, str]]:
    """Without ambiguous sets of which no member would stand in the file in the set's place: one of nothing is nothing."""
    looked, named = linearised.looked, {name: _acting(estimate) for name, estimate in estimates.items()}

    def stands(name: EffectName, group: Sequence[EffectName]) -> bool:
        others = tuple(member for member in decision.best.members if linearised.terms[member[0]].key not in group)
        estimate = estimated(linearised.evidence, dataclasses.replace(decision.best, members=others), name)
        if not is_possible(name.effect, estimate.parameters):
            return False
        with_it = {**named, name: estimate.parameters}
        file = File.of(looked.arm, looked.points, looked.parts.known, with_it, {}, firmer, is_last=False)
        return file.has(name) and file.sureness(name, estimate) >= 1.0

    fallen = [group for group in decision.ambiguous if not any(stands(name, group) for name in group)]
    why = {group[0]: f"{listed(group)} may as well be none, whichever it is" for group in fallen}
    sets = tuple(group for group in decision.ambiguous if group not in fallen)
    return dataclasses.replace(decision, ambiguous=sets, remainders=(*decision.remainders, *fallen)), {**reasons, **why}


def _acting(estimate: Estimated) -> Parameters:
    """Its parameters; none of what is found to be nothing."""
    return {} if _is_nothing(estimate) else estimate.parameters


def _maps(file: File, report: Mask) -> MeasuredMaps | None:
    """What sets share as the file's maps, and what these are worth at the poses (m,) that report; None where there are none."""
    if file.unshared is None:
        return None
    before, after = (one.fit.residuals().sizes(report)["tip_m"] for one in (file.unshared, file))
    return MeasuredMaps(file.arm.maps, (MapCheck("tip_m", None, before, after),))


def _open_members(linearised: Linearised, decision: Decision) -> dict[EffectName, Parameters]:
    """Of every ambiguous set one beside the names, with its first estimate, if there is one: the likeliest that a map can follow,
    else what the best set has.
    """
    best, members = decision.best, {}
    present = {linearised.terms[k].key for k, _ in best.members}
    for group in decision.ambiguous:
        ranked = sorted(group, key=lambda name: (name not in present, -decision.probability.get(name, 0.0)))
        for name in [name for name in ranked if follows(name)][:1] or [name for name in ranked if name in present]:
            if name not in decision.names:
                parameters = estimated(linearised.evidence, best, name).parameters if name in present else {}
                members[name] = parameters if is_possible(name.effect, parameters) else {}
    return members


def _named_alone(linearised: Linearised, best: Weighed, names: Sequence[EffectName]) -> Weighed:
    """The set without what has no name; its laws depart as they do."""
    return dataclasses.replace(best, members=tuple(member for member in best.members if linearised.terms[member[0]].key in names))


def _square(residual: Residuals, floor: Floor, rows: Mask) -> float:
    return residual.times(floor.tip_m, floor.turn_rad, rows) ** 2


def _pays(looked: Looked, given: Fit, file: File) -> bool:
    """Whether the geometry of a file pays beside the arm as it was given."""
    known = looked.parts.known
    before, after = (_square(fit.residuals(), looked.floor, known) for fit in (given, file.fit))
    return pays(before, after, 3 * int(known.sum()), file.identification.rank)


def pays(nominal: float, fitted: float, rows: int, parameters: int) -> bool:
    """Whether a fit surely gains more than its parameters do by chance; both leave mean squares, in variances of the floor.

    p parameters gain a chi-square of p, p +- sqrt(2 p), in the noise that the fit leaves: a floor that is hardly known may lie
    below that, and then all fits gain.
    """
    noise = max(1.0, fitted * rows / max(rows - parameters, 1))
    return rows * (nominal - fitted) / noise > parameters + SURE_sd * math.sqrt(2.0 * parameters)


def _finding(
    linearised: Linearised,
    decision: Decision,
    reasons: Mapping[EffectName, str],
    effects: tuple[NamedEffect, ...],
    floor: Floor,
    ends: tuple[Residuals, Residuals],
) -> GapFinding:
    """`ends`: what is left before and after."""
    looked, report = linearised.looked, linearised.looked.parts.report
    (before_si, after_si), (before, after) = zip(
        *((left.sizes(report), left.times(floor.tip_m, floor.turn_rad, report)) for left in ends), strict=True
    )
    noise = {channel: size for channel, size in floor.sizes.items() if channel in before_si}
    remainder, unknown = remainders(linearised, decision, reasons), unknown_part(linearised, decision, reasons)
    could = nameable(linearised.evidence)
    has_free = FREE in looked.points.setup
    return GapFinding(
        arm=looked.arm.name,
        data=("points.csv",),
        noise_floor=noise,
        gap_before=before,
        gap_after=after,
        before_si={channel: before_si[channel] for channel in noise},
        after_si={channel: after_si[channel] for channel in noise},
        effects=effects,
        ambiguous=decision.ambiguous,
        unknown=unknown,
        nameable=could,
        next_experiment=next_experiment(decision.ambiguous, unknown, could, has_free),
        is_held_out=looked.parts.is_divided,
        remainder=remainder,
        open_questions=open_questions(decision.ambiguous, remainder),
    )


def _borne_out(
    linearised: Linearised, decision: Decision, firmer: Collection[EffectName]
) -> tuple[Decision, Mapping[EffectName, Estimated], Mapping[EffectName, str]]:
    """Without names that the data do not bear out, which become remainders, each with its reason; without blocks that no
    pose that was left out shows.
    """
    best = decision.best
    estimates = {name: estimated(linearised.evidence, best, name) for name in decision.names}
    shown = [group for group in decision.remainders if _shows_elsewhere(linearised, best, group)]
    nameless = [k for k, _ in best.members if any(linearised.terms[k].key in group for group in shown)]
    there = [*decision.names, *(name for names in decision.ambiguous for name in names)]

    def why_not(name: EffectName, estimate: Estimated) -> str:
        """Why a name is not given; empty if it is. What the arm's file has is a total, and may be nothing; that, and what other
        recordings know better, is not for these poses to bear out.
        """
        is_known = name in firmer or _known(linearised.looked.arm, name) is not None
        if _is_nothing(estimate):
            is_right = is_known or name.effect == FRAME
            return "" if is_right else f"{name} acts, but these poses do not tell how large it is"
        if not is_possible(name.effect, estimate.parameters):
            return f"{name} was identified with impossible values"
        if estimate.departure > LAW_MOST:
            return f"{name} departs too far from its law"
        if not is_known and not holds_on_others(linearised, best, name, there):
            return f"{name} does not improve held-out poses"
        if not is_known and _may_be_error_of(linearised, best, name, nameless):
            return f"{name} is no larger than the error of the unexplained residual"
        return ""

    reasons = {name: why for name, estimate in estimates.items() if (why := why_not(name, estimate))}
    names = tuple(name for name in decision.names if name not in reasons)
    remainders = (*shown, *((name,) for name in reasons))
    return dataclasses.replace(decision, names=names, remainders=remainders), estimates, reasons


def _may_be_error_of(linearised: Linearised, best: Weighed, name: EffectName, nameless: Sequence[int]) -> bool:
    """Whether blocks without a name explain so much more than a name that their error would pass for it.

    A block is no law: what it stands for differs from it by at least as much as the roughest part from its law.
    """
    number = next(k for k, _ in best.members if linearised.terms[k].key == name)
    if not nameless or linearised.terms[number].slope_Nm is not None:  # the currents speak for a torque
        return False
    explained, *others = (share_of(linearised.evidence, best, [k]) for k in (number, *nameless))
    return explained < LAW_MOST**2 * sum(others)


def _is_nothing(estimate: Estimated) -> bool:
    """Whether the size that was found may as well be none."""
    return not estimate.differs_from(np.zeros_like(estimate.value))


def _shows_elsewhere(linearised: Linearised, best: Weighed, group: tuple[Key, ...]) -> bool:
    """Whether the blocks of a remainder that are in the best set help poses that they were not fitted to."""
    present = {linearised.terms[k].key for k, _ in best.members}
    blocks = [key for key in group if isinstance(key, Block) and key in present]
    return not blocks or any(shows_in_others(linearised, best, key) for key in blocks)


def _known(arm: Arm, name: EffectName) -> Effect | None:
    """What the arm's file has of this name."""
    return next((one for one in arm.effects if (one.effect, one.joint) == (name.effect, name.joint)), None)


def _is_new(arm: Arm, name: EffectName, estimate: Estimated) -> bool:
    """Whether the total differs from what the arm's file has. What its tolerances say is there is not nothing."""
    known = _known(arm, name)
    if _is_nothing(estimate) and name in {EffectName(*effect_key(text, arm)) for text in made_effects(arm)}:
        return False
    if known is None:
        return not _is_nothing(estimate)
    before = () if is_load(name.effect) else linear_values(name.effect, known.parameters)
    if before:
        return estimate.differs_from(np.array(before))
    return any(
        key not in known.parameters or not abs(value - known.parameters[key]) <= SURE_sd * sd
        for key, (value, sd) in estimate.parameters.items()
    )


def _ordered(linearised: Linearised, best: Weighed, names: Sequence[EffectName]) -> list[EffectName]:
    """By the share that each explains."""
    numbers = {linearised.terms[k].key: k for k, _ in best.members}
    present = [name for name in names if name in numbers]
    return sorted(present, key=lambda name: -share_of(linearised.evidence, best, [numbers[name]]))


def _named(linearised: Linearised, decision: Decision, file: File, name: EffectName, total: Estimated, gap: float) -> NamedEffect:
    numbers = {linearised.terms[k].key: k for k, _ in decision.best.members}
    is_nothing = _is_nothing(total)  # without parameters: a stiffness is then anything from some size on
    return NamedEffect(
        name,
        {} if is_nothing else file.parameters(name, total.parameters),
        gap,
        beside={} if is_nothing else values_alone(total.parameters),
        probability=decision.probability[name],
        share=share_of(linearised.evidence, decision.best, [numbers[name]]),
        departure=total.departure,
        variable=total.variable,
        is_nothing=is_nothing,
    )


def _geometry(file: File) -> Parameters:
    """The DH deviations under the names of docs/formats.md, with standard deviations."""
    sd = {one.parameter.name: one.sd for one in file.identification.estimates}
    deviation = file.identification.deviations.ravel().tolist()
    return {
        f"link{k // 4 + 1}_{LINK_KEYS[k % 4]}": (deviation[k], sd.get(name, math.nan))
        for k, name in enumerate(dh_names(len(deviation) // 4))
    }
