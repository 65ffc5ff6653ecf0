"""The model as fitted so far: geometry, what effects move, how sure every flank is; and the next linearisation around it."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, Mask, frozen
from calib.gap.effects.catalogue import is_load, pose_terms
from calib.gap.effects.links import FRAME, beyond_linear_m
from calib.gap.effects.record import PoseScene, load_of
from calib.gap.finding import EffectName, effect_of, with_totals
from calib.gap.poses.currents import holding_currents
from calib.gap.poses.floor import Floor, counted_rad, flank_covariance, noise_floor
from calib.gap.poses.linear import Fit, Linear, Residuals, by_joints
from calib.gap.poses.nameless import blocks_of
from calib.gap.poses.recordings import Split
from calib.gap.posterior.constants import FLOOR_DOUBT
from calib.gap.posterior.evidence import Evidence, Weighed
from calib.gap.posterior.term import Block, Key, Term
from calib.gap.posterior.told import Told
from calib.points.points import Points
from control.model.arm import Arm
from control.model.effects import EFFECTS

STEP = 1e-3  # of an unknown, in bounds: a few micrometres, some tens of microradians


@dataclass(frozen=True, slots=True)
class State:
    """The point of linearisation: the geometry, joints moved by turn_rad (m, n), tip and last link by `moved` (m, 6: m, rad).

    `linear` (m, 6): the part of these moves that is linear in coefficients. `weight` (R, 3, 3) whitens rows whose flank is
    uncertain, None: of none; `loaded`: the arm with the geometry and the loads found so far. `follows` (m, 6, k): how these moves
    follow the geometry, since loads do; None: not at all.
    """

    fit: Fit
    turn_rad: Array
    moved: Array
    linear: Array
    weight: Array | None
    loaded: Arm
    follows: Array | None = None

    @classmethod
    def bare(cls, fit: Fit, arm: Arm) -> State:
        """The geometry alone; `arm` carries the loads that its file states."""
        m, n = fit.problem.observed.q_rad.shape
        still = np.zeros((m, 6))
        return cls(fit, np.zeros((m, n)), still, still, None, fit.shaped(arm))

    @property
    def joint_rad(self) -> Array:
        """The joints' angles (m, n): the encoders', with what the file and the effects found so far add."""
        return frozen(self.fit.problem.observed.q_rad + self.turn_rad)

    def posed(self) -> Fit:
        """The fit of the problem with what the effects move."""
        moved = copy.copy(self.fit.problem)
        observed = moved.observed
        moved.observed = dataclasses.replace(
            observed,
            q_rad=self.joint_rad,
            known_shift_m=_beside(observed.known_shift_m, self.moved[:, :3]),
            known_turn_rad=_beside(observed.known_turn_rad, self.moved[:, 3:]),
        )
        return dataclasses.replace(self.fit, problem=moved)


def _beside(known: Array | None, more: Array) -> Array:
    """What arm's file and found effects do together."""
    return frozen(more if known is None else known + more)


@dataclass(frozen=True, slots=True)
class Looked:
    """What the posterior looks at: the arm, without and with only the loads of the effects that are looked for, the poses and
    their split, the geometry fitted alone, the noise floor, the outliers `out` (m,), the effects that are left out of the list,
    sentences about the data, and what other recordings tell.
    """

    arm: Arm
    bare_arm: Arm
    loaded: Arm
    points: Points
    parts: Split
    fit: Fit
    floor: Floor
    out: Mask
    without: Collection[str]
    warnings: tuple[str, ...]
    told: Told | None = None

    def refloored(self, residual: Residuals) -> Looked:
        """With the noise as repeats show it beside what a model leaves: a joint that drifts parts repeats, too."""
        floor = noise_floor(self.arm, self.points, residual, self.out)
        return dataclasses.replace(self, floor=floor) if math.isfinite(floor.tip_m) else self


@dataclass(frozen=True, slots=True)
class Linearised:
    """All terms around a state, as the evidence of their sets from the poses that are looked at."""

    state: State
    looked: Looked
    linear: Linear
    evidence: Evidence

    @property
    def terms(self) -> tuple[Term, ...]:
        """In the evidence's order."""
        return self.evidence.terms

    @classmethod
    def of(cls, state: State, looked: Looked, blocks: Sequence[Term] = (), keys: Collection[Key] | None = None) -> Linearised:
        """`blocks`: of a look before; `keys`: only these terms."""
        arm, points, floor = looked.bare_arm, looked.points, looked.floor
        scene = PoseScene.of(state.fit.shaped(arm), state.loaded, points, state.joint_rad)
        effects: Collection[str] = EFFECTS.keys()
        if keys is not None:  # of those left out of the list the keys are blocks
            effects = {key.effect if isinstance(key, EffectName) else key.variable for key in keys}
        names = [_unlisted(term, looked.without) for term in pose_terms(scene, effects)]
        terms = [term for term in (*names, *(blocks or blocks_of(scene, names))) if keys is None or term.key in keys]
        linear = Linear.around(state.posed(), floor.lever_m, terms, state.linear, state.weight, state.follows)
        held = holding_currents(state.fit, arm, points, state.turn_rad, terms)
        rows = looked.parts.known
        seen = None if held is None else held.seen(rows)
        gram = linear.projected(rows, floor.tip_m, seen, _stopped(looked.arm, points))
        if looked.told is not None:
            gram = looked.told.beside(gram, terms, linear.columns_of_terms)
        return cls(state, looked, linear, Evidence(gram, terms, max(floor.doubt, FLOOR_DOUBT)))

    @property
    def blocks(self) -> tuple[Term, ...]:
        """Those terms that never had a name; they need not follow the fit."""
        return tuple(one for one in self.terms if isinstance(one.key, Block) and one.parameters is None)

    def columns(self, numbers: Sequence[int]) -> Array:
        """What terms do to the rows, (3R, c)."""
        if not numbers:
            return np.zeros((len(self.linear.y), 0))
        return np.concatenate([self.linear.columns[:, self.linear.places[k]] for k in numbers], axis=1)

    def fitted(self, weighed: Weighed) -> tuple[Array, Residuals]:
        """Geometry x (k,) beside a set, and what they leave of all poses."""
        fit, residual = self._solved(weighed)
        return fit.x, residual

    def _solved(self, weighed: Weighed) -> tuple[Fit, Residuals]:
        size, _ = self.evidence.estimate(weighed.members, weighed.kappa)
        move, linear = self.columns([k for k, _ in weighed.members]) @ size, self.linear
        x = linear.geometry(self.looked.parts.known, self.looked.floor.tip_m * weighed.kappa, move)
        return self.state.fit.at(x), linear.measured.as_residuals(linear.y - linear.base @ x - move)

    def moved_m(self, weighed: Weighed, numbers: Sequence[int]) -> Array:
        """What the terms `numbers` of a set do to the tips, (m, 3)."""
        return self._moved(weighed, numbers).tip_m

    def moves(self, weighed: Weighed, numbers: Sequence[int]) -> bool:
        """Whether they move a tip or an orientation at all."""
        moved = self._moved(weighed, numbers)
        return bool(moved.tip_m.any() or np.nan_to_num(moved.turn_rad).any())

    def _moved(self, weighed: Weighed, numbers: Sequence[int]) -> Residuals:
        moved = np.zeros(len(self.linear.y))
        for number, size in self.evidence.sizes(weighed).items():
            if number in numbers:
                moved += self.columns([number]) @ size
        return self.linear.measured.as_residuals(moved)

    def gravity_Nm(self) -> Array | None:
        """Gravity's torques under the loads found, (m, n); None for an arm without masses."""
        return load_of(self.state.loaded, self.looked.points, self.state.joint_rad)

    def next_state(self, weighed: Weighed, follows: Array | None = None) -> State:
        """Linearised anew around a set, its laws evaluated at the geometry and loads found with it.

        `follows`: as of a state of the same set before, near enough; else it is found anew, where laws follow the geometry.
        """
        linear, looked, noise_m = self.linear, self.looked, self.looked.floor.tip_m
        fit, _ = self._solved(weighed)
        beyond, extra = np.zeros_like(self.state.moved), np.zeros_like(linear.weight)
        acting, loads = [], []
        for number, size in self.evidence.sizes(weighed).items():
            term = self.terms[number]
            acting.append((term, size))
            extra += flank_covariance(linear.measured, term, float(size[0]) / noise_m)
            if term.key == EffectName(FRAME):
                beyond[:, :3] += beyond_linear_m(term, size, fit.problem.references_m)
            if isinstance(term.key, EffectName) and is_load(term.key.effect) and term.parameters is not None:
                loads.append(effect_of(term.key, term.parameters(size[:1] * term.size, np.zeros((1, 1)))))
        weight = np.linalg.inv(np.linalg.cholesky(np.eye(3) + extra))
        loaded = with_totals(fit.shaped(self.state.loaded), loads)
        effects = {term.key.effect for term, _ in acting if isinstance(term.key, EffectName)}
        encoder_rad = fit.problem.observed.q_rad

        def moves(there: Fit, turn_rad: Array) -> tuple[Array, Array]:
            scene = PoseScene.of(there.shaped(looked.bare_arm), there.shaped(loaded), looked.points, encoder_rad + turn_rad)
            # each as it is there, or itself if it is not there
            same = {(term.key, term.variant, term.count): term for term in reversed(pose_terms(scene, effects))}
            moving = [(same.get((term.key, term.variant, term.count), term), size) for term, size in acting]
            return _moves(moving, turn_rad.shape)

        before = _moves(acting, encoder_rad.shape)
        turn, moved = moves(fit, before[0])
        new = State(fit, turn, moved + beyond, moved, weight, loaded)
        by_joint = np.concatenate(by_joints(new.posed()), axis=1)

        def at_tip(turned: Array, shifted: Array) -> Array:
            return np.asarray(np.einsum("mn,min->mi", turned, by_joint) + shifted)

        here = at_tip(turn, moved)
        change_m = (here - at_tip(*before))[looked.parts.known, :3]
        if follows is None and float(np.linalg.norm(change_m)) > noise_m:
            # with the arm's shape, of which the unknowns of frames and boards are none
            frames = {name for frame in fit.problem.free_frames for name in frame.parameter_names}
            follows = np.zeros((*moved.shape, len(fit.x)))
            for k, parameter in enumerate(fit.problem.parameters):
                if parameter.name not in frames:
                    there = dataclasses.replace(fit, x=fit.x + STEP * (np.arange(len(fit.x)) == k))
                    follows[:, :, k] = (at_tip(*moves(there, turn)) - here) / STEP
        return dataclasses.replace(new, linear=here, follows=follows)


def _moves(acting: Sequence[tuple[Term, Array]], shape: tuple[int, int]) -> tuple[Array, Array]:
    """What terms of coefficients (c,) do to joints, (m, n), and to tip and last link, (m, 6)."""
    turn, moved = np.zeros(shape), np.zeros((shape[0], 6))
    for term, size in acting:
        turn += 0.0 if term.slope_rad is None else np.einsum("c,cmn->mn", size, term.slope_rad)
        moved[:, :3] += 0.0 if term.slope_m is None else np.einsum("c,cmi->mi", size, term.slope_m)
        moved[:, 3:] += 0.0 if term.turn_rad is None else np.einsum("c,cmi->mi", size, term.turn_rad)
    return turn, moved


def _stopped(arm: Arm, points: Points) -> Term:
    """Where in its count each joint came to rest: on the side that it came from, or on the other; nothing tells how far.

    A servo stops as soon as it reads what it was sent to, so that steps of its encoder look like play.
    """
    sides = points.direction * counted_rad(arm, points)
    slope = np.einsum("mj,jk->jmk", sides, np.eye(points.joint_count))
    return Term(Block(0, "counts"), laws=len(slope), slope_rad=slope)


def _unlisted(term: Term, without: Collection[str]) -> Term:
    """A term whose effect was left out of the list, as a block."""
    if not isinstance(term.key, EffectName) or term.key.effect not in without:
        return term
    return dataclasses.replace(term, key=Block(term.key.joint or 0, term.key.effect), words=f"{term.key} (left out of the list)")
