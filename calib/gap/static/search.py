"""From everything that is tried to what is kept: decide, refit, look again, and hold every name to what is left."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, Mask
from calib.gap.finding import Unknown
from calib.gap.static.candidate import Candidate
from calib.gap.static.candidates import candidates
from calib.gap.static.currents import Currents
from calib.gap.static.decision import Decision, decide, with_doubt
from calib.gap.static.doubles import doubles
from calib.gap.static.evidence import Evidence
from calib.gap.static.floor import Floor
from calib.gap.static.held_out import unborne
from calib.gap.static.judgement import Judgement, explained_share, judge
from calib.gap.static.linearised import Linearised
from calib.gap.static.model import Fitted, fitted, unsound
from calib.gap.static.remainder import remainders
from calib.gap.static.shape import Shape
from calib.gap.static.split import Split
from calib.points import Points
from control.model.arm import Arm

LOOKS = 3  # the geometry moves when an effect joins it, and the evidence is linear around it: look again
FREEDOM_SHARE = (
    0.2  # of all values, that must be left beyond what is fitted for their scatter to tell anything
)


@dataclass(frozen=True, slots=True)
class Search:
    """What is searched: poses and their split, candidates, shapes without a name, the geometry alone, floor, currents.

    noise_m: what the evidence takes for noise: the floor, or what all candidates together leave where that is more.
    """

    arm: Arm
    points: Points
    parts: Split
    tried: tuple[Candidate, ...]
    shapes: tuple[Shape, ...]
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
            stays = [(one.name, one.shape) for one in chosen] == [(one.name, one.shape) for one in fit.chosen]
            if stays and look != 1:
                break
            fit = fitted(self.arm, self.points, self.parts.known, chosen)
            if unsound(fit, self.parts.known, self.noise_m):
                fit = fitted(self.arm, self.points, self.parts.known, plain)
            if look == LOOKS - 1 or not chosen:
                break
            search = search._around_geometry(fit)
        return search, decision, fit

    def _around_geometry(self, fit: Fitted) -> Search:
        """With candidates at the geometry of a fit."""
        known = {one.name for one in self.tried}
        moved = candidates(self.arm.with_dh(fit.solution.dh), self.points)
        return dataclasses.replace(self, tried=tuple(one for one in moved if one.name in known))

    def judged(self, decision: Decision, fit: Fitted) -> Judgement:
        """What of the decision is kept: not what other recordings do not bear out, what a shape without a name would replace,
        nor what the remainder contradicts.
        """
        left = remainders(fit, self.parts.known, self.shapes, self.noise_m)
        twins = self._twins(decision, fit)
        broken = unborne(self.around(fit.geometry_x), self.tried, decision.best.chosen, self.parts)
        vague = unsound(fit, self.parts.known, self.noise_m)
        broken = tuple(k for k in decision.best.chosen if k in broken or self.tried[k].name in vague)
        sure = {self.tried[k].name for k in decision.accepted if k not in twins and k not in broken}
        accepted = [one for one in fit.chosen if one.name in sure]
        verdict = judge(accepted, decision.leader, self.bare, fit, left, self.parts.known, self.floor.tip_m)
        if verdict.unknown is not None or not (twins or broken):
            return verdict
        share = round(explained_share(self.bare, fit, self.parts.known, self.floor.tip_m), 3)
        for number, shape in twins.items():
            return Judgement(verdict.kept, Unknown(shape.words, self.tried[number].name, share))
        name = self.tried[broken[0]].name
        where = (
            f"what {name} would explain shows in too few poses to tell its size"
            if name in vague
            else f"what {name} explains in some recordings, others that could show it do not bear out"
        )
        return Judgement(verdict.kept, Unknown(where, name, share))

    def _twins(self, decision: Decision, fit: Fitted) -> dict[int, Shape]:
        """Accepted names that a shape without a name would replace."""
        if not decision.accepted:
            return {}
        around = self.around(fit.geometry_x)
        seen = [k for k in decision.best.chosen if self.tried[k].moves_tip]
        columns = [around.columns(c) * c.size for c in self.tried]
        columns += [around.columns(shape) for shape in self.shapes]
        ends = np.cumsum([column.shape[1] for column in columns])
        at = [list(range(end - column.shape[1], end)) for column, end in zip(columns, ends, strict=True)]
        keep, count = np.repeat(self.parts.known, 3), len(self.tried)
        evidence = Evidence.of(around.base[keep], np.concatenate(columns, axis=1)[keep], around.y[keep])
        return doubles(evidence, at[:count], at[count:], self.tried, seen, self.shapes)


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
