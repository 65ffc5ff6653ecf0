"""Step by step: which effect pays most on runs that were not fitted, and by how much over its rivals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import Array
from calib.gap.dynamic.catalogue import Candidate
from calib.gap.dynamic.fit import Fitted, refine
from calib.gap.dynamic.rows import Rows
from calib.gap.dynamic.screen import Screen, Start
from calib.gap.dynamic.sizes import is_worth_a_name
from calib.gap.dynamic.split import Split
from calib.gap.finding import EffectName
from calib.gap.signals.terms import Term
from control.progress import Advance

# Fixed on seeds that no reported figure uses; docs/gap_scores.md lists those.
MATERIAL = (
    0.10  # of a floor's square: what an effect must take off the mean square of the cells that it claims
)
EVIDENCE = 30.0  # log evidence on held-out runs, correlated rows counted once
MARGIN = 15.0  # log evidence over the runner-up, else both are in the ambiguous set
SHARE_MARGIN = (
    0.02  # of the gain: rivals closer than this are not told apart by data whose laws are not exact
)
WORTH = 0.25  # of the best first-order gain: candidates below it are not refined
WIDTH_SHARES = (0.7, 1.0, 1.4, 1.8, 2.3)  # of the width that the tip at rest would need
LINK_SHARES = (0.0, 0.25, 0.5, 0.75)  # of a joint's friction, behind its gear
SOFTNESS_SHARES = (0.5, 0.7, 0.85, 1.0, 1.2, 1.5, 2.0)  # of what the tip at rest would need
DAMPING, DAMPINGS = 0.3, (0.1, 0.5, 2.0)  # N m s/rad
LOOKED_AT = 8  # starts, the best first
HOPE = 0.5  # of the bar: refinement may gain as much again
MOST_STEPS = 5
FOLLOWING = 0.01  # of what was claimed in a cell before: laws that are a little wrong leave that much
UNEXPLAINED_STEPS = (
    2  # after this many steps that only unlisted candidates could take, the rest is unknown too
)
FIRST_LAWS = ("coulomb_friction", "viscous_friction")
CAMERA_TIME, SAMPLING_TIME = "camera time", "sampling time"
OF_SENSORS = (CAMERA_TIME, SAMPLING_TIME)
ELASTIC = ("joint_compliance", "backlash")


@dataclass(frozen=True, slots=True)
class Trial:
    """A candidate refined beside what is in the model already."""

    candidate: Candidate
    fitted: Fitted


@dataclass(frozen=True, slots=True)
class Step:
    """What was added and why: the best trial, its rivals in order, the fit before, log evidence and claims by cell."""

    best: Trial
    rivals: tuple[Trial, ...]
    before: Fitted
    evidence: float
    margin: float
    claims: Array


def _is_unexplained(step: Step) -> bool:
    candidate = step.best.candidate
    return not candidate.is_listed and candidate.name.effect not in OF_SENSORS


def _is_a_zero(trial: Trial, trials: Sequence[Trial]) -> bool:
    """A drift that is hardly better than another zero of its joint: what does not change shows no drift."""
    if trial.candidate.name.effect != "thermal_drift":
        return False
    return any(
        other.candidate.name.effect == "zero"
        and other.candidate.name.joint == trial.candidate.name.joint
        and other.fitted.held_out < trial.fitted.held_out + 2.0 * MARGIN
        for other in trials
    )


class Choice:
    """The search over one recording."""

    def __init__(
        self, rows: Rows, known: Sequence[Term], split: Split, pool: Sequence[Candidate], advance: Advance
    ) -> None:
        self.rows, self.known, self.pool = rows, tuple(known), list(pool)
        self._advance, self._split_given = advance, split
        self.screen = Screen(rows, known, split.deciding)
        self._begin(split)

    def _begin(self, split: Split) -> None:
        """Nothing found yet, all rows of the split to be looked at."""
        self.split = split
        self.screen.pick(split.deciding)
        self.first = self.refined(())

    def steps(self) -> list[Step]:
        """Steps until nothing pays any more."""
        done: list[Step] = []
        fitted = self.first
        while (step := self._step(fitted, done, self._first_laws())) is not None:
            done.append(step)
            fitted = step.best.fitted
        most = len(done) + MOST_STEPS
        while len(done) < most:
            step = self._step(fitted, done, self.pool)
            if step is None:
                break
            if sum(_is_unexplained(s) for s in done) >= UNEXPLAINED_STEPS:
                break
            done.append(step)
            fitted = self._without_flights(done)
        needless = self._needless(done)
        if needless is None:
            return done
        self._begin(self._split_given)
        self.pool = [one for one in self.pool if one.name != needless]
        return self.steps()

    def _needless(self, done: Sequence[Step]) -> EffectName | None:
        """What other names have made needless: what came first took whatever it could. Found again without it, they show."""
        terms = done[-1].best.fitted.terms if done else ()
        named = [k for k, step in enumerate(done) if step.best.candidate.is_listed]
        if len(named) < 2:
            return None
        whole = self.refined([terms[k] for k in named])
        first_laws = {one.name for one in self._first_laws()}
        for k in named:
            if done[k].best.candidate.name in first_laws:
                continue
            rest = self.refined([terms[other] for other in named if other != k])
            if 0.5 * (rest.held_out - whole.held_out) * self._weight(whole, done[k].claims) < EVIDENCE:
                return done[k].best.candidate.name
        return None

    def _without_flights(self, done: list[Step]) -> Fitted:
        """After a play is added: go on without the rows that it cannot speak of; earlier claims by what is left."""
        fitted = done[-1].best.fitted
        if done[-1].best.candidate.name.effect != "backlash":
            return fitted
        resting = self.rows.resting((*self.known, *fitted.terms))
        self.split = self.split.only(resting)
        self.screen.pick(self.split.deciding)
        self.first = self.refined(())
        for k, step in enumerate(done):
            claims = self.by_cell(step.before.residual) - self.by_cell(step.best.fitted.residual)
            done[k] = replace(step, claims=claims)
        last = replace(done[-1].best, fitted=self.refined(fitted.terms))
        done[-1] = replace(done[-1], best=last)
        return last.fitted

    def nearest(self, fitted: Fitted) -> tuple[EffectName | None, float]:
        """The effect of the list that comes nearest to what a fit leaves, and the share of the excess, to first order."""
        starts = [self.screen.best_start(c, fitted) for c in self.pool if c.is_listed]
        excess = fitted.picked - float(self.counts().sum())
        if not starts or excess <= 0.0:
            return None, 0.0
        best = max(starts, key=lambda start: start.gain)
        if best.gain < EVIDENCE:
            return None, 0.0
        return best.candidate.name, min(best.gain / excess, 1.0)

    def _first_laws(self) -> list[Candidate]:
        """Coulomb and viscous friction of joints whose file has none: every gear has them, so they come first."""
        has = {(e.effect, e.joint) for e in self.rows.physics.arm.effects}
        return [
            candidate
            for candidate in self.pool
            if candidate.name.effect in FIRST_LAWS
            and not any((law, candidate.name.joint) in has for law in FIRST_LAWS)
        ]

    def refined(self, terms: Sequence[Term]) -> Fitted:
        """These terms at their best on the deciding runs, beside what the arm's file has."""
        return refine(self.rows, self.known, terms, self.split.deciding, self.split.groups)

    def _step(self, fitted: Fitted, done: Sequence[Step], pool: Sequence[Candidate]) -> Step | None:
        taken = {(s.best.candidate.name.effect, s.best.candidate.name.joint) for s in done}
        part = 0.1 + 0.8 * (1.0 - 0.6 ** len(done))
        self._advance(f"screening, step {len(done) + 1}", part)
        starts = [
            self.screen.best_start(candidate, fitted)
            for candidate in pool
            if (candidate.name.effect, candidate.name.joint) not in taken
        ]
        starts.sort(key=lambda start: -start.gain)
        prior = np.sum([step.claims for step in done], axis=0) if done else np.zeros(len(self.counts()))
        if not any(self._is_promising(start, fitted, prior) for start in starts[:LOOKED_AT]):
            return None
        trials = []
        for k, start in enumerate(self._worth_refining(starts)):
            self._advance(f"step {len(done) + 1}: {start.candidate}", part + 0.03 * min(k, 8))
            fits = [
                self.refined((*fitted.terms, self._nearer(fitted, term)))
                for term in (start.term, *start.others)
            ]
            trials.append(Trial(start.candidate, min(fits, key=lambda fit: fit.held_out)))
        trials.sort(key=lambda trial: trial.fitted.held_out)
        return self._judged(trials, fitted, prior)

    def _nearer(self, fitted: Fitted, term: Term) -> Term:
        """A start for a play or a spring: where a link flies between flanks, what it shows at rest says little of its width.

        Then the share of the joint's friction that acts behind the gear, whose valley is narrow: a fit that starts far
        from it ends in another. The same for a spring, whose resonance may lie within the motion.
        """
        if term.form == "joint_compliance":
            softness = term.values[0]
            spring = self._best_of(fitted, [term.at((softness * s, DAMPING, 0.0)) for s in SOFTNESS_SHARES])
            others = [(damping, share) for damping in DAMPINGS for share in LINK_SHARES[::2]]
            return self._best_of(fitted, [spring.at((spring.values[0], *other)) for other in others])
        if term.form != "backlash":
            return term
        width = self._best_of(fitted, [term.at((term.values[0] * share, 0.0)) for share in WIDTH_SHARES])
        return self._best_of(fitted, [width.at((width.values[0], share)) for share in LINK_SHARES])

    def _best_of(self, fitted: Fitted, tried: Sequence[Term]) -> Term:
        """The one of a joint's plays or springs that leaves least on the deciding rows."""
        deciding, beside = self.split.deciding, (*self.known, *fitted.terms)
        self.rows.physics.following.foresee(beside, tried)

        def left(one: Term) -> float:
            return float(np.sum(self.rows.residual((*beside, one))[deciding] ** 2))

        return min(tried, key=left)

    def _is_promising(self, start: Start, fitted: Fitted, prior: Array) -> bool:
        """Whether a start could, to first order, claim what `_judged` asks of an effect in one cell at least."""
        if start.gain < EVIDENCE:
            return False
        if not start.change:  # found by trying, not by slopes
            return True
        ahead = fitted.residual + self.screen.slopes(start.origin) @ np.array(start.change)
        claims = self.by_cell(fitted.residual) - self.by_cell(ahead)
        return bool(np.any(claims > HOPE * np.maximum(MATERIAL * self.counts(), FOLLOWING * prior)))

    def _worth_refining(self, starts: Sequence[Start]) -> list[Start]:
        """The best few, listed and unlisted; an elastic joint's first-order gain says little, so its bar is lower."""
        best = starts[0].gain
        result: list[Start] = []
        for is_listed, most in ((True, 4), (False, 2)):
            own = [s for s in starts if s.candidate.is_listed == is_listed and s.gain > WORTH * best]
            result += own[:most]
        pairs = [s for s in starts if s.term.form in ELASTIC and s.gain > WORTH * best and s not in result]
        return result + pairs[:2]

    def _judged(self, trials: list[Trial], before: Fitted, prior: Array) -> Step | None:
        best = self._preferred(trials)
        claims = self.by_cell(before.residual) - self.by_cell(best.fitted.residual)
        counts = self.counts()
        gain = before.held_out - best.fitted.held_out
        weight = self._weight(best.fitted, claims)
        evidence = 0.5 * gain * weight
        bar = np.maximum(MATERIAL * counts, FOLLOWING * prior)
        if best.candidate.name.effect in FIRST_LAWS and not self._is_possible(best.fitted.terms[-1]):
            return None
        is_small = not is_worth_a_name(self.rows.physics.arm, best.fitted.terms[-1])
        if gain <= 0.0 or evidence < EVIDENCE or np.all(claims < bar) or is_small:
            return None
        rivals = tuple(trial for trial in trials if trial is not best)
        listed = [trial for trial in rivals if trial.candidate.is_listed]
        margin = np.inf
        if listed:
            runner_up = min(trial.fitted.held_out for trial in listed)
            margin = 0.5 * (runner_up - best.fitted.held_out) * weight
        return Step(best, rivals, before, evidence, float(margin), claims)

    def _is_possible(self, term: Term) -> bool:
        """Friction in all, with what the file has of it, does not push."""
        has = sum(k.values[0] for k in self.known if k.form == term.form and k.name == term.name)
        return has + term.values[0] > 0.0

    def _preferred(self, trials: list[Trial]) -> Trial:
        """The best on held-out runs; an effect of the list before an unlisted one that is hardly better."""
        trials = [trial for trial in trials if not _is_a_zero(trial, trials)] or trials
        best = trials[0]
        listed = [trial for trial in trials if trial.candidate.is_listed]
        nameless = [trial for trial in trials if trial.candidate.is_shape]
        # Laws of geometry are exact: a name leads every shape without one, or it is a guess.
        if nameless and (
            not listed or nameless[0].fitted.held_out < listed[0].fitted.held_out + 2.0 * MARGIN
        ):
            return nameless[0] if best.candidate.is_listed else best
        if best.candidate.is_listed or not listed:
            return best
        lost = listed[0].fitted.held_out - best.fitted.held_out
        gained = max(self.first.held_out - best.fitted.held_out, 1e-9)
        return listed[0] if lost < max(2.0 * MARGIN, 0.003 * gained) else best

    def _weight(self, fitted: Fitted, claims: Array) -> float:
        """Rows that follow each other are not independent where the law is not exact: an effective share of them."""
        worst = int(np.argmax(claims))
        cell = self.rows.table.cells[worst]
        residual = fitted.residual[cell.rows][self.split.deciding[cell.rows]]
        spread = max(1.0, float(np.mean(residual**2)))
        step = 3 if cell.channel == "tip_m" else 1
        series = residual[::step]
        lag = float(series[1:] @ series[:-1] / max(float(series @ series), 1e-12))
        lag = min(max(lag, 0.0), 0.98)
        return (1.0 - lag) / (1.0 + lag) / spread

    def by_cell(self, residual: Array) -> Array:
        """Sum of squares of the deciding rows, by cell."""
        deciding = self.split.deciding
        return np.array(
            [float(np.sum(residual[c.rows][deciding[c.rows]] ** 2)) for c in self.rows.table.cells]
        )

    def counts(self) -> Array:
        """Deciding rows by cell."""
        return np.array([float(self.split.deciding[c.rows].sum()) for c in self.rows.table.cells])
