"""Validation on the held-out runs: a name that makes them fit worse is withdrawn.

They decide nothing else: no effect is found, fitted or preferred by them, so that the gap on them stays an honest one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import Array
from calib.gap.dynamic.choose import Choice, Step
from calib.gap.dynamic.fit import Fitted
from calib.gap.dynamic.verdict import Verdict, corrections, terms_of, where
from calib.gap.finding import EffectName, Unknown

TOGETHER_s = 0.5  # rows of a cell in this time are taken as one, as a law that errs does so for a while
BEYOND_sd = 1.0
BEYOND_SHARE = (
    0.02  # of the squared gap: growth beyond it says that the law is not theirs, however much it scatters
)


@dataclass(frozen=True, slots=True)
class Validated:
    """What is left of a verdict, its fit, and a sentence for each name that was taken back."""

    verdict: Verdict
    accepted: Fitted
    warnings: tuple[str, ...]


def validate(choice: Choice, steps: Sequence[Step], verdict: Verdict) -> Validated:
    """Take back names, the worst first, with which the held-out runs fit worse beyond the growth's deviation or share."""
    said: list[str] = []
    while True:
        terms = terms_of(steps, verdict)
        accepted = choice.refined((*terms, *corrections(steps, verdict)))
        grown = {k: _grown(choice, accepted, place) for place, k in enumerate(verdict.named)}
        most, _ = growth(choice, accepted.residual**2)
        worse = [k for k, (more, sd) in grown.items() if more > min(BEYOND_sd * sd, BEYOND_SHARE * most)]
        if not worse:
            return Validated(verdict, accepted, tuple(said))
        worst = max(worse, key=lambda k: grown[k][0])
        name = steps[worst].best.candidate.name
        said.append(f"{name}: helps the runs that decide, but not those held out: not named")
        verdict = _without(choice, steps[worst], verdict, worst, name)


def _without(choice: Choice, step: Step, verdict: Verdict, k: int, name: EffectName) -> Verdict:
    cell = int(np.argmax(step.claims))
    text = f"{where(choice, step.before.residual, cell)}: {name} does not bear it out on the held-out runs"
    unknown = verdict.unknown or Unknown(text, name, verdict.explained[k])
    return replace(verdict, named=tuple(one for one in verdict.named if one != k), unknown=unknown)


def _grown(choice: Choice, accepted: Fitted, place: int) -> tuple[float, float]:
    """By how much a term makes the squared gap of the reporting rows grow, and that growth's deviation."""
    others = (*accepted.terms[:place], *accepted.terms[place + 1 :])
    without = choice.rows.residual((*choice.known, *others))
    return growth(choice, accepted.residual**2 - without**2)


def growth(choice: Choice, more: Array) -> tuple[float, float]:
    """Sum over cells of the mean of `more` (rows,) on the reporting rows; its deviation from what half-seconds scatter."""
    table, reporting = choice.rows.table, choice.split.reporting
    total, variance = 0.0, 0.0
    for cell in table.cells:
        picked = reporting[cell.rows]
        count = int(picked.sum())
        if not count:
            continue
        block = (table.t_s[cell.rows][picked] // TOGETHER_s).astype(np.intp)
        run = table.run[cell.rows][picked]
        _, index = np.unique(run * (block.max() + 1) + block, return_inverse=True)
        sums = np.bincount(index, weights=more[cell.rows][picked]) / count
        total += float(sums.sum())
        variance += float(np.sum((sums - sums.mean()) ** 2))
    return total, float(np.sqrt(variance))
