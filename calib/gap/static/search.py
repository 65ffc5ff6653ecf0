"""From everything that is tried to what is kept: decide, refit, look again, and hold every name to what is left."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.link_bending import FLEXURE
from calib.arrays import Array, Mask
from calib.gap.finding import EffectName, Unknown
from calib.gap.model_update import effect_of, with_named
from calib.gap.poses.candidate import Candidate
from calib.gap.poses.candidates import candidates
from calib.gap.poses.currents import Currents
from calib.gap.poses.evidence import Evidence
from calib.gap.poses.floor import Floor
from calib.gap.poses.generic import shapes
from calib.gap.poses.load_shapes import contradiction
from calib.gap.poses.model import Fitted, fitted, parameters_of, unsound, unsure
from calib.gap.poses.shape import Shape
from calib.gap.static.confounders import confounders
from calib.gap.static.decision import FURTHER_COST, Decision, decide, with_doubt
from calib.gap.static.held_out import refuted
from calib.gap.static.judgement import Judgement, explained_share, is_same_joint, judge
from calib.gap.static.linearised import Linearised, places
from calib.gap.static.remainder import Remainder, remainders
from calib.gap.static.split import Split
from calib.points.points import Points
from control.model.arm import Arm

LOOKS = 3  # the geometry moves when an effect joins it, and the evidence is linear around it: look again
FREEDOM_SHARE = (
    0.2  # of all values, that must be left beyond what is fitted for their scatter to tell anything
)


@dataclass(frozen=True, slots=True)
class Search:
    """What is searched: poses and their split, candidates, the geometry alone, floor, currents.

    loaded: the arm at the geometry and under the loads that have been found, at which candidates and shapes are looked at.
    noise_m: what the evidence takes for noise: the floor, or what all candidates together leave where that is more.
    """

    arm: Arm
    points: Points
    parts: Split
    tried: tuple[Candidate, ...]
    loaded: Arm
    bare: Fitted
    floor: Floor
    noise_m: float
    currents: Currents | None

    def around(self, x: Array) -> Linearised:
        """Linear around geometry x."""
        return Linearised.around(self.bare.problem, x, self.noise_m, self.currents)

    def searched(self) -> tuple[Search, Decision, Fitted]:
        """Decide around the geometry alone, refit with what was decided, and look again until it stays.

        Loads hang on the geometry: once an effect has joined it, they are those of the fitted one. What is returned has them.
        """
        search, fit = self, self.bare
        for look in range(LOOKS):
            evidence = search.around(fit.geometry_x).evidence(search.tried, self.parts.known)
            decision = decide(evidence, search.tried)
            plain = tuple(search.tried[k] for k in decision.best.chosen)
            chosen = tuple(with_doubt(evidence, search.tried, decision.best, k) for k in decision.best.chosen)
            idle = self._idle(search, fit, chosen)
            if idle:
                decision = decision.without(idle, search.tried)
                chosen = tuple(one for one in chosen if one.name not in idle)
                plain = tuple(one for one in plain if one.name not in idle)
            stays = [(one.name, one.shape) for one in chosen] == [(one.name, one.shape) for one in fit.chosen]
            if stays and look != 1:
                break
            fit = fitted(self.arm, self.points, self.parts.known, chosen)
            for more in (plain, tuple(dataclasses.replace(one, unsure=None) for one in plain)):
                if not unsound(fit, self.parts.known, self.noise_m):
                    break
                fit = fitted(self.arm, self.points, self.parts.known, more)  # the evidence tells the rest
            if look == LOOKS - 1 or not chosen:
                break
            search = search._around(fit)
        return search, decision, fit

    def _idle(self, search: Search, fit: Fitted, chosen: Sequence[Candidate]) -> set[EffectName]:
        """Names that pay only in poses in which nobody can tell the flank of a play beside them."""
        doubt = unsure(chosen, len(self.points))
        if len(chosen) < 2 or not doubt.any():
            return set()
        evidence = search.around(fit.geometry_x).evidence(chosen, self.parts.known & ~doubt)
        at = places(chosen)
        whole = evidence.log(range(len(evidence.pull)))
        paid = [whole - evidence.log([p for o in at if o != own for p in o]) for own in at]
        return {
            one.name
            for one, pays in zip(chosen, paid, strict=True)
            if one.unsure is None and pays < FURTHER_COST
        }

    def _around(self, fit: Fitted) -> Search:
        """With candidates at the geometry of a fit, and under the loads that it found."""
        known, moved = {one.name for one in self.tried}, self.arm.with_dh(fit.solution.dh)
        values = parameters_of(fit, self.parts.known, self.noise_m, self.currents)
        chosen = zip(fit.chosen, values, strict=True)
        loads = [effect_of(one.name, found) for one, found in chosen if one.slope_Nm is not None]
        loaded = with_named(moved, loads)
        tried = tuple(one for one in candidates(moved, self.points, loaded) if one.name in known)
        return dataclasses.replace(self, tried=tried, loaded=loaded)

    def judged(self, decision: Decision, fit: Fitted) -> Judgement:
        """What of the decision is kept: not what other recordings do not bear out, what a shape without a name would replace,
        nor what the remainder contradicts.
        """
        nameless = shapes_beside(self.tried, self.loaded, self.points)
        left = remainders(fit, self.parts.known, nameless, self.noise_m)
        confounded, unsupported = self._replaceable(decision, fit, left, nameless)
        broken = refuted(self.around(fit.geometry_x), self.tried, decision.best.chosen, self.parts)
        vague = unsound(fit, self.parts.known, self.noise_m)
        broken = tuple(k for k in decision.best.chosen if k in broken or self.tried[k].name in vague)
        loads = [self.tried[k] for k in decision.best.chosen if not self.tried[k].moves_tip]
        against = contradiction(self.currents, loads, self.points.q_rad, self.parts.known)
        if against is not None:
            vague |= {one.name for one in loads}
            broken = tuple(k for k in decision.best.chosen if k in broken or self.tried[k].name in vague)
        sure = {
            self.tried[k].name for k in decision.accepted if k not in {*confounded, *unsupported, *broken}
        }
        accepted = [
            one
            for one in fit.chosen
            if one.name in sure and not any(is_same_joint(one, shape) for shape in confounded.values())
        ]
        verdict = judge(accepted, decision.leader, self.bare, fit, left, self.parts.known, self.floor)
        if verdict.unknown is not None or not (
            confounded or broken
        ):  # unsupported names come with one of these
            return verdict
        share = round(explained_share(self.bare, fit, self.parts.known, self.floor.tip_m), 3)
        for number, shape in confounded.items():
            return Judgement(verdict.kept, Unknown(shape.words, self.tried[number].name, share))
        name = self.tried[broken[0]].name
        if against is not None:
            return Judgement(verdict.kept, Unknown(against, loads[0].name, share))
        where = (
            f"what {name} would explain shows in too few poses to tell its size"
            if name in vague
            else f"what {name} explains in some recordings, others that could show it do not bear out"
        )
        return Judgement(verdict.kept, Unknown(where, name, share))

    def _replaceable(
        self, decision: Decision, fit: Fitted, left: Sequence[Remainder], nameless: Sequence[Shape]
    ) -> tuple[dict[int, Shape], set[int]]:
        """Names that a shape without a name would replace, and names that pay only beside such, or beside what is left."""
        seen = [k for k in decision.best.chosen if self.tried[k].moves_tip]
        if not seen:
            return {}, set()
        evidence, at, shapes_at = self._evidence_beside(nameless, fit)
        confounded = confounders(evidence, at, shapes_at, self.tried, seen, nameless)
        number = {id(shape): k for k, shape in enumerate(nameless)}
        instead = [number[id(shape)] for shape in confounded.values()]
        instead += [number[id(one.shape)] for one in left[:1]]
        if not instead:
            return confounded, set()
        beside = [place for k in dict.fromkeys(instead) for place in shapes_at[k]]
        rest = [k for k in seen if k not in confounded]
        whole = evidence.log([*beside, *(place for k in rest for place in at[k])])
        unsupported = {
            k
            for k in rest
            if whole - evidence.log([*beside, *(place for o in rest if o != k for place in at[o])])
            < FURTHER_COST
        }
        return confounded, unsupported

    def _evidence_beside(
        self, nameless: Sequence[Shape], fit: Fitted
    ) -> tuple[Evidence, list[list[int]], list[list[int]]]:
        """Of all candidates and all shapes without a name at once, and where each has its columns."""
        around = self.around(fit.geometry_x)
        columns = [around.columns(c) * c.size for c in self.tried]
        columns += [around.columns(shape) for shape in nameless]
        ends = np.cumsum([column.shape[1] for column in columns])
        at = [list(range(end - column.shape[1], end)) for column, end in zip(columns, ends, strict=True)]
        keep, count = np.repeat(fit.sure(self.parts.known), 3), len(self.tried)
        evidence = Evidence.of(around.base[keep], np.concatenate(columns, axis=1)[keep], around.y[keep])
        return evidence, at[:count], at[count:]


def shapes_beside(tried: Sequence[Candidate], arm: Arm, points: Points) -> tuple[Shape, ...]:
    """The shapes without a name; links that bend among them where the list lacks these."""
    return shapes(arm, points, has_bending=all(one.name.effect != FLEXURE for one in tried))


def working_noise_m(bare: Fitted, rows: Mask, tried: Sequence[Candidate], floor_m: float) -> float:
    """What all candidates together leave, where that is more than the floor.

    Structure that nobody knows is no noise, but weighing effects as if it were not there would name the nearest of them.
    """
    evidence = Linearised.around(bare.problem, bare.x, floor_m).evidence(tried, rows)
    inner = np.eye(len(evidence.pull)) + evidence.gram
    used = float(np.trace(np.linalg.solve(inner, evidence.gram)))
    freedom = evidence.count - len(bare.x) - used
    if freedom < FREEDOM_SHARE * evidence.count:
        return floor_m
    left = evidence.left_with(range(len(evidence.pull))) / freedom
    return floor_m * max(1.0, float(np.sqrt(left)))
