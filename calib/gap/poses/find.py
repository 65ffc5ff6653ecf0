"""Static poses from end to end: noise floor, the posterior over sets of effects, and its answer."""

from __future__ import annotations

import functools
import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.parallel_axes import parallel_joints, tilt_row, with_tilt_behind
from calib.arrays import Array
from calib.errors import UnusablePointsError
from calib.gap.effects.catalogue import are_total_in_poses, is_load, pose_terms
from calib.gap.effects.record import PoseScene
from calib.gap.finding import EffectName
from calib.gap.poses.answer import answered
from calib.gap.poses.cautions import about_data, cleaned, require_posed
from calib.gap.poses.floor import FINEST_m, Floor, middle, noise_floor, outlying
from calib.gap.poses.linear import Fit, Linear
from calib.gap.poses.nameless import SKEWED
from calib.gap.poses.outcome import StaticGap
from calib.gap.poses.recordings import Split, split
from calib.gap.poses.state import Linearised, Looked, State
from calib.gap.posterior.constants import UNMEASURED, SETTLED_sd
from calib.gap.posterior.decide import Decision, decide
from calib.gap.posterior.search import Search
from calib.gap.posterior.term import Block, Key, Term
from calib.gap.posterior.told import Told
from calib.points.points import Points
from calib.settling import FITS_MOST, Settling
from calib.validation.verdict import TO_MEASURE_NOISE
from control.model.arm import Arm
from control.plain_text import Advance, silent

FREEDOM_LEAST = 60  # values beyond all parameters that a noise from the richest model needs


def find(arm: Arm, points: Points, advance: Advance = silent, without: Collection[str] = ()) -> StaticGap:
    """Name what is missing in the model of `arm` at these poses; `without` leaves effects out of the list.

    UnusablePointsError for points that tell nothing.
    """
    advance("reading the poses", 0.0)
    warnings = (*require_posed(arm, points), *about_data(arm, points))
    advance("fitting the geometry", 0.05)
    return look(_prepared(arm, cleaned(points), without, warnings), advance)


def look(prepared: Looked, advance: Advance = silent, prior: Told | None = None) -> StaticGap:
    """The answer of poses whose geometry is fitted; `prior` is what other recordings of the arm tell of its effects."""
    prepared = replace(prepared, told=prior)
    linearised, decision = _searched(prepared, advance)
    if skewed := _skewed(prepared.arm, decision):
        # geometry that DH rows do not hold: everything beside it is looked at anew
        arm = functools.reduce(with_tilt_behind, skewed, prepared.arm)
        warnings = (*prepared.warnings, _tilted(arm, skewed))
        prepared = replace(_prepared(arm, prepared.points, prepared.without, warnings), told=prior)
        linearised, decision = _searched(prepared, advance)
    advance("reporting", 0.85)
    return answered(prepared, linearised, decision)


def _skewed(arm: Arm, decision: Decision) -> list[int]:
    """Joints behind which a block of the answer tilts the next axis across the link."""
    blocks = [key for group in decision.remainders for key in group if isinstance(key, Block)]
    return [joint for joint in parallel_joints(arm) if Block(0, f"{SKEWED} {joint}") in blocks]


def _tilted(arm: Arm, joints: Sequence[int]) -> str:
    pairs = ", ".join(f"{joint} and {joint + 1}" for joint in joints)
    rows = ", ".join(f"row {tilt_row(arm, joint) + 1}" for joint in joints)
    return (
        f"the axes of joints {pairs} are not parallel, and DH rows of parallel axes have no parameter for it: the new arm.toml"
        f" has a fixed row in between, whose alpha_rad is the tilt ({rows}); links behind it count on from there"
    )


def _prepared(arm: Arm, points: Points, without: Collection[str], warnings: tuple[str, ...]) -> Looked:
    """The geometry alone fitted, outliers left out, the noise found."""
    totals = [effect for effect in arm.effects if are_total_in_poses(effect.effect) and effect.effect not in without]
    loads = [effect for effect in totals if is_load(effect.effect)]
    bare_arm = replace(arm, effects=tuple(effect for effect in arm.effects if effect not in totals))
    loaded = replace(bare_arm, effects=(*bare_arm.effects, *loads))
    parts = split(points)
    fit = Fit.to(problem_of(bare_arm, points, Choice().for_points(bare_arm, points)), parts.known)
    fitted = fit.shaped(bare_arm)
    scene = PoseScene.of(fitted, replace(fitted, effects=loaded.effects), points, fit.problem.observed.q_rad)
    variants = _laws(scene, without)
    laws = [middle(same) for same in variants]
    residual = fit.residuals()
    first = noise_floor(arm, points, residual)
    scatter_m = _scatter_m(first, residual.tip_m)
    linear = Linear.around(fit, replace(first, tip_m=scatter_m).lever_m, laws)
    out = outlying(linear, variants, scatter_m)
    if out.any():
        parts = parts.without(out)
        fit = Fit.to(fit.problem, parts.known)
        residual = fit.residuals()
    floor = noise_floor(arm, points, residual, out)
    if not math.isfinite(floor.tip_m):
        richest = _from_the_richest(Linear.around(fit, 0.0, laws), parts, residual.tip_m)
        floor = replace(richest, turn_rad=floor.turn_rad)
    return Looked(arm, bare_arm, loaded, points, parts, fit, floor, out, without, warnings)


def _laws(scene: PoseScene, without: Collection[str]) -> list[list[Term]]:
    """The law of every effect on every joint in all its variants, without departures."""
    variants: dict[Key, list[Term]] = {}
    for term in pose_terms(scene):
        if isinstance(term.key, EffectName) and term.key.effect not in without:
            variants.setdefault(term.key, []).append(term.law_alone())
    return list(variants.values())


def _scatter_m(floor: Floor, residual_m: Array) -> float:
    """A first idea of the noise: that of repeats or the data sheet, else of what the better half of the poses leave."""
    return floor.tip_m if math.isfinite(floor.tip_m) else float(np.median(np.abs(residual_m))) / 0.6745


def _from_the_richest(linear: Linear, parts: Split, residual_m: Array) -> Floor:
    """The noise as what every effect of the list together leaves, where nothing else tells it.

    UnusablePointsError where the poses are too few for that.
    """
    scale = max(float(np.sqrt(np.mean(residual_m[parts.known] ** 2))), FINEST_m)
    gram = linear.projected(parts.known, scale)
    freedom = 3 * int(parts.known.sum()) - linear.base.shape[1] - len(gram.pull)
    if freedom < FREEDOM_LEAST:
        raise UnusablePointsError(
            f"the noise of these points is not known: {TO_MEASURE_NOISE}, or give [camera] position_noise_m in arm.toml"
        )
    size = np.linalg.solve(np.eye(len(gram.pull)) + gram.tip, gram.pull)
    chi_square = gram.left - 2.0 * size @ gram.pull + size @ gram.tip @ size
    return Floor(
        max(scale * math.sqrt(max(chi_square, 0.0) / freedom), FINEST_m),
        "what the best explanation leaves: there are too few repeats in one posture and no camera's noise, so that an effect"
        " beyond the list would pass for noise",
        UNMEASURED,
    )


def _searched(looked: Looked, advance: Advance) -> tuple[Linearised, Decision]:
    """Look, linearise anew where the best set settles, with the noise that repeats then show, and look again until a set is the
    best at its own place, or was it before.
    """
    forced = [EffectName(one.effect, one.joint) for one in looked.arm.effects if are_total_in_poses(one.effect)]
    blocks: tuple[Term, ...] = ()

    def settled(state: State, keys: Collection[Key]) -> State:
        """The values of a set where they settle, by Gauss and Newton's steps."""
        settling = Settling(FITS_MOST)
        while settling.goes_on:
            linearised = Linearised.of(state, looked, blocks, keys)
            further = linearised.next_state(Search(linearised.evidence, forced).of(keys), state.follows)
            moved_m = (further.posed().residuals().tip_m - state.posed().residuals().tip_m)[looked.parts.known]
            if settling.takes(float(np.linalg.norm(moved_m)), SETTLED_sd * looked.floor.tip_m):
                state = further
        return state

    state, starts = State.bare(looked.fit, looked.loaded), list[frozenset[Key]]()
    seen: set[frozenset[Key]] = set()
    while True:
        advance("weighing effects", 0.8 - 0.6 / (1.0 + len(seen)))
        linearised = Linearised.of(state, looked, blocks)
        blocks = linearised.blocks
        search = Search(linearised.evidence, forced)
        sets = search.run(starts)
        decision = decide(linearised.evidence, sets)
        keys = search.keys(decision.best.members)
        if keys in seen or not keys:
            return linearised, decision
        seen.add(keys)
        starts = [keys, frozenset(key for key in keys if isinstance(key, EffectName))]
        state = settled(linearised.next_state(decision.best), keys)
        looked = looked.refloored(state.posed().residuals())
