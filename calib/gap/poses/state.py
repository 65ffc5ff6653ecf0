"""The model as fitted so far: geometry, what effects move, how sure every flank is; and the next linearisation around it."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, Mask, frozen
from calib.gap.effects.catalogue import is_load, pose_terms
from calib.gap.effects.frame import FRAME, beyond_linear_m
from calib.gap.effects.pose_scene import Scene, load_of
from calib.gap.finding import EffectName
from calib.gap.model_update import effect_of, with_totals
from calib.gap.poses.currents import Currents
from calib.gap.poses.linear import Linear, of_currents, tip_by_joint
from calib.gap.poses.nameless.blocks import blocks_of
from calib.gap.posterior.evidence import Evidence
from calib.gap.posterior.search import Weighed
from calib.gap.posterior.term import Block, Term
from calib.points.points import Points
from control.model.arm import Arm


@dataclass(frozen=True, slots=True)
class State:
    """The point of linearisation: unknowns x (k,), joints moved by turn_rad (m, n), the tip by shift_m (m, 3).

    `linear_m` (m, 3): the part of these moves that is linear in coefficients. `weight` (m, 3, 3) whitens poses whose flank is
    uncertain; `loaded`: the arm with the geometry and the loads found so far.
    """

    problem: ArmProblem
    x: Array
    turn_rad: Array
    shift_m: Array
    linear_m: Array
    weight: Array
    loaded: Arm

    @classmethod
    def bare(cls, problem: ArmProblem, x: Array, arm: Arm) -> State:
        """The geometry alone; `arm` carries the loads that its file states."""
        m, n = problem.observed.q_rad.shape
        still = np.zeros((m, 3))
        weight = np.tile(np.eye(3), (m, 1, 1))
        return cls(problem, x, np.zeros((m, n)), still, still, weight, arm.with_dh(problem.solution(x).dh))

    def posed(self) -> ArmProblem:
        """The problem with what the effects move."""
        moved = copy.copy(self.problem)
        known = self.problem.observed.known_shift_m
        shift = self.shift_m if known is None else self.shift_m + known
        moved.observed = dataclasses.replace(
            self.problem.observed,
            q_rad=frozen(self.problem.observed.q_rad + self.turn_rad),
            known_shift_m=frozen(shift),
        )
        return moved


@dataclass(frozen=True, slots=True)
class Around:
    """All terms around a state, as the evidence of their sets from the poses `rows`."""

    state: State
    arm: Arm
    points: Points
    rows: Mask
    noise_m: float
    linear: Linear
    evidence: Evidence

    @property
    def terms(self) -> tuple[Term, ...]:
        """In the evidence's order."""
        return self.evidence.terms

    @classmethod
    def of(
        cls,
        state: State,
        arm: Arm,
        points: Points,
        rows: Mask,
        noise: tuple[float, float],
        currents: Currents | None,
        without: Collection[str],
        blocks: Sequence[Term] = (),
    ) -> Around:
        """`arm`: without the effects that are looked for; `noise`: floor [m] and its doubt; `blocks`: of a look before."""
        scene = Scene.of(arm.with_dh(state.loaded.dh), state.loaded, points)
        names = [_unlisted(one, without) for one in pose_terms(scene)]
        terms = [*names, *(blocks or blocks_of(scene, names))]
        problem = state.posed()
        linear = Linear.around(problem, state.x, state.linear_m, terms, state.weight)
        gram = linear.projected(rows, noise[0], of_currents(currents, terms, rows))
        return cls(state, arm, points, rows, noise[0], linear, Evidence(gram, terms, noise[1]))

    @property
    def blocks(self) -> tuple[Term, ...]:
        """Those terms that never had a name; they need not follow the fit."""
        return tuple(one for one in self.terms if isinstance(one.key, Block) and one.parameters is None)

    def columns(self, numbers: Sequence[int]) -> Array:
        """What terms do to the tips, (3m, c)."""
        if not numbers:
            return np.zeros((len(self.linear.y), 0))
        return np.concatenate([self.linear.columns[:, self.linear.places[k]] for k in numbers], axis=1)

    def fitted(self, found: Weighed) -> tuple[Array, Array]:
        """Geometry x beside a set, and the residuals (m, 3) of all poses."""
        size, _ = self.evidence.estimate(found.members, found.kappa)
        move = self.columns([k for k, _ in found.members]) @ size
        x, _ = self.linear.geometry(self.rows, self.noise_m * found.kappa, move)
        return x, (self.linear.y - self.linear.base @ x - move).reshape(-1, 3)

    def moved_m(self, found: Weighed, numbers: Sequence[int]) -> Array:
        """What the terms `numbers` of a set do to the tips, (m, 3)."""
        size, _ = self.evidence.estimate(found.members, found.kappa)
        moved, first = np.zeros(len(self.linear.y)), 0
        for number, _ in found.members:
            own = size[first : first + self.terms[number].count]
            first += len(own)
            if number in numbers:
                moved += self.columns([number]) @ own
        return moved.reshape(-1, 3)

    def gravity_Nm(self) -> Array | None:
        """Gravity's torques under the loads found, (m, n); None for an arm without masses."""
        return load_of(self.state.loaded, self.points)

    def next_state(self, found: Weighed) -> State:
        """Linearised anew around a set."""
        state = self.state
        size, _ = self.evidence.estimate(found.members, found.kappa)
        x, _ = self.fitted(found)
        turn, shift = np.zeros_like(state.turn_rad), np.zeros_like(state.shift_m)
        extra, beyond, first, loads = np.zeros_like(state.weight), np.zeros_like(shift), 0, []
        problem = state.posed()
        by_joint = tip_by_joint(problem, state.x)
        for number, _ in found.members:
            one = self.terms[number]
            own = size[first : first + one.count]
            first += one.count
            turn += 0.0 if one.slope_rad is None else np.einsum("c,cmn->mn", own, one.slope_rad)
            shift += 0.0 if one.slope_m is None else np.einsum("c,cmi->mi", own, one.slope_m)
            if one.doubt is not None and isinstance(one.key, EffectName) and one.key.joint is not None:
                lever = by_joint[:, :, one.key.joint - 1] * (one.size * own[0] / self.noise_m)
                extra += one.doubt[:, None, None] * lever[:, :, None] * lever[:, None, :]
            if one.key == EffectName(FRAME):
                beyond += beyond_linear_m(one, own, state.problem.references_m)
            if isinstance(one.key, EffectName) and is_load(one.key.effect) and one.parameters is not None:
                loads.append(effect_of(one.key, one.parameters(own[:1] * one.size, np.zeros((1, 1)))))
        weight = np.linalg.inv(np.linalg.cholesky(np.eye(3) + extra))
        moved = dataclasses.replace(state, x=x, turn_rad=turn, shift_m=shift + beyond, weight=weight)
        by_joint = tip_by_joint(moved.posed(), x)
        linear = np.einsum("mn,min->mi", turn, by_joint) + shift
        loaded = with_totals(state.loaded.with_dh(moved.problem.solution(x).dh), loads)
        return dataclasses.replace(moved, linear_m=linear, loaded=loaded)


def _unlisted(one: Term, without: Collection[str]) -> Term:
    """A term whose effect was left out of the list, as a block."""
    if not isinstance(one.key, EffectName) or one.key.effect not in without:
        return one
    return dataclasses.replace(
        one, key=Block(one.key.joint or 0, one.key.effect), words=f"{one.key} (left out of the list)"
    )
