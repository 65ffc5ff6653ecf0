"""What the steps mean: names, sets that cannot be told apart, and what is unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.dynamic.catalogue import Candidate
from calib.gap.dynamic.choose import FIRST_LAWS, MARGIN, OF_SENSORS, SHARE_MARGIN, Choice, Step
from calib.gap.finding import EffectName, Unknown
from calib.gap.signals.terms import Term
from control.model.arm import Arm

SUFFICIENT = 0.99  # of what a cell showed beyond its floor, and the effect claims, a name has to take
SUFFICIENT_ROUGH = {  # laws whose form differs between real joints, and impacts that no step resolves
    "stribeck_friction": 0.97,
    "joint_compliance": 0.97,
    "backlash": 0.97,
    "link_flexure": 0.97,
}
MANY_VALUES = 2
SHARE_EXACT = 0.002  # of the evidence, where both effects are geometry
GEOMETRIC = {
    "encoder_eccentricity",
    "encoder_scale",
    "belt_coupling",
    "thermal_drift",
    "link_geometry",
    "base_frame",
}
AT_FLOOR = 1.3  # mean square over the floor's: models without any hidden effect reach this in single cells
LEFT = 1.5  # of the floor's square, and
LEFT_SHARE = 0.05  # of what a cell showed at first: less than both is nothing unknown
HARMED = (
    0.3  # of the floor's square: a cell that is worse by this with all that was found is contradicted by it
)
SHADOW = 0.5  # a name needs at least this share of what something unknown takes in the same cell


@dataclass(frozen=True, slots=True)
class Verdict:
    """Steps that are named, ambiguous sets, and what is unknown."""

    named: tuple[int, ...]
    ambiguous: tuple[tuple[EffectName, ...], ...]
    unknown: Unknown | None
    explained: tuple[float, ...]
    corrected: tuple[int, ...] = ()  # steps that say something of the sensors, not of the arm


def judge(choice: Choice, steps: Sequence[Step], arm: Arm) -> Verdict:
    """Decide over all steps together."""
    last = steps[-1].best.fitted.residual if steps else choice.first.residual
    counts = choice.counts()
    left = np.maximum(choice.by_cell(last) - AT_FLOOR * counts, 0.0)
    harmed = choice.by_cell(last) - choice.by_cell(choice.first.residual) > HARMED * counts
    explained = tuple(_explained(step.claims, left) for step in steps)
    sound: list[int] = []
    rejected: list[int] = []
    corrected: list[int] = []
    for k, step in enumerate(steps):
        if _is_correction(step, explained[k]):
            corrected.append(k)
            continue
        is_sound = step.best.candidate.is_listed and _suffices(step, explained[k], arm)
        # Two errors of one encoder can be another law of its motor, and cancel at the tip but for their difference.
        is_sound = is_sound and not np.any(np.abs(step.claims[harmed]) > LEFT * counts[harmed])
        is_first = is_sound and _is_first_law(step.best.candidate.name, arm)
        if is_sound and (is_first or not _in_shadow(steps, rejected, k)):
            sound.append(k)
        elif np.any(step.claims > LEFT * counts):  # else it is too small to be worth a word
            rejected.append(k)
    # A later unknown can be larger in a cell than an effect that was sound before it.
    shadowed = [
        k
        for k in sound
        if _in_shadow(steps, rejected, k) and not _is_first_law(steps[k].best.candidate.name, arm)
    ]
    sound, fallen = _alone(choice, steps, [k for k in sound if k not in shadowed], corrected, arm)
    rivals = {k: _rivals(steps[k], arm) for k in sound}
    named = [k for k in sound if not rivals[k]]
    ambiguous = tuple((steps[k].best.candidate.name, *rivals[k]) for k in sound if k not in named)
    unknown = _unknown(choice, steps, rejected + shadowed + fallen, left)
    return Verdict(tuple(named), ambiguous, unknown, explained, tuple(corrected))


def _is_correction(step: Step, explained: float) -> bool:
    """When camera or currents are read, where that suffices: no effect of the arm, but no unknown either."""
    return step.best.candidate.name.effect in OF_SENSORS and explained >= SUFFICIENT


def _alone(
    choice: Choice, steps: Sequence[Step], named: list[int], corrected: list[int], arm: Arm
) -> tuple[list[int], list[int]]:
    """Names that also suffice without what is not named: something unlisted beside them may have hidden what is left."""
    fallen: list[int] = []
    named = list(named)
    while named and len(named) + len(corrected) < len(steps):
        terms = [steps[-1].best.fitted.terms[k] for k in (*named, *corrected)]
        residual = choice.refined(terms).residual
        left = np.maximum(choice.by_cell(residual) - AT_FLOOR * choice.counts(), 0.0)
        weak = [k for k in named if not _suffices(steps[k], _explained(steps[k].claims, left), arm)]
        if not weak:
            break
        worst = min(weak, key=lambda k: _explained(steps[k].claims, left))
        named.remove(worst)
        fallen.append(worst)
    return named, fallen


def _explained(claims: Array, left: Array) -> float:
    """Share of what the claimed cells show beyond the floor, weighted by the claims."""
    own = np.maximum(claims, 0.0)
    own = np.where(own > 0.05 * own.max(), own, 0.0)
    total = float(own.sum())
    return float(np.sum(own * own / np.maximum(own + left, 1e-12)) / max(total, 1e-12))


def _suffices(step: Step, explained: float, arm: Arm) -> bool:
    name = step.best.candidate.name
    if _is_first_law(name, arm):
        return True
    return explained >= SUFFICIENT_ROUGH.get(name.effect, SUFFICIENT)


def _is_first_law(name: EffectName, arm: Arm) -> bool:
    """Every gear has Coulomb and viscous friction: where the file has none, held-out gain alone accepts them."""
    if name.effect not in FIRST_LAWS:
        return False
    return not any(e.effect in FIRST_LAWS and e.joint == name.joint for e in arm.effects)


def _in_shadow(steps: Sequence[Step], unknowns: Sequence[int], k: int) -> bool:
    """Whether something unknown is larger where this effect has its claim."""
    own = np.maximum(steps[k].claims, 0.0)
    main = own > 0.3 * own.max()
    return any(other != k and np.any(own[main] < SHADOW * steps[other].claims[main]) for other in unknowns)


def _rivals(step: Step, arm: Arm) -> tuple[EffectName, ...]:
    """Listed rivals that the margin does not beat."""
    is_first = _is_first_law(step.best.candidate.name, arm)
    if step.margin >= max(MARGIN, SHARE_MARGIN * step.evidence):
        return ()
    lead = step.best.fitted.held_out
    listed = [trial for trial in step.rivals if trial.candidate.is_listed]
    per_loss = step.margin / max(min(t.fitted.held_out for t in listed) - lead, 1e-9)
    return tuple(
        trial.candidate.name
        for trial in listed
        if (trial.fitted.held_out - lead) * per_loss < _bar(step, trial.candidate, is_first)
    )


def _bar(step: Step, rival: Candidate, is_first: bool) -> float:
    """Evidence over a rival that settles it.

    Laws of friction are never exact, so that rivals within a share of the evidence are not told apart; geometry is. A
    rival that needs many more values to come as near would have to be so by chance.
    """
    best = step.best.candidate
    if is_first:  # every gear has both frictions, but which of them these runs show has to be seen
        return MARGIN if rival.name.effect in FIRST_LAWS else 0.0
    if len(rival.starts[0].values) > MANY_VALUES * len(best.starts[0].values):
        return MARGIN
    is_exact = best.name.effect in GEOMETRIC and rival.name.effect in GEOMETRIC
    return max(MARGIN, (SHARE_EXACT if is_exact else SHARE_MARGIN) * step.evidence)


def _unknown(choice: Choice, steps: Sequence[Step], rejected: Sequence[int], left: Array) -> Unknown | None:
    if rejected:
        k = max(rejected, key=lambda one: float(np.maximum(steps[one].claims, 0.0).sum()))
        return _from_step(choice, steps[k], left)
    counts = choice.counts()
    first = np.maximum(choice.by_cell(choice.first.residual) - counts, 0.0)
    beyond = choice.by_cell(_last(choice, steps)) - counts
    over = beyond > np.maximum(LEFT * counts, LEFT_SHARE * first)
    if not np.any(over):
        return None
    cell = int(np.argmax(np.where(over, beyond / np.maximum(counts, 1.0), 0.0)))
    nearest, share = choice.nearest(steps[-1].best.fitted if steps else choice.first)
    return Unknown(where(choice, _last(choice, steps), cell), nearest, share)


def _last(choice: Choice, steps: Sequence[Step]) -> Array:
    return steps[-1].best.fitted.residual if steps else choice.first.residual


def _from_step(choice: Choice, step: Step, left: Array) -> Unknown:
    """The nearest effect of the list, and the share of the excess that it alone takes."""
    listed = [trial for trial in (step.best, *step.rivals) if trial.candidate.is_listed]
    own = np.maximum(step.claims, 0.0)
    main = own > 0.05 * own.max()
    before = choice.by_cell(step.before.residual)[main] - choice.counts()[main]
    if not listed:
        nearest, explained = choice.nearest(step.before)
    else:
        after = choice.by_cell(listed[0].fitted.residual)[main] - choice.counts()[main]
        nearest = listed[0].candidate.name
        explained = float(np.clip(1.0 - after.sum() / max(before.sum(), 1e-9), 0.0, 1.0))
    text = step.best.candidate.where
    return Unknown(text or where(choice, step.before.residual, int(np.argmax(own))), nearest, explained)


def where(choice: Choice, residual: Array, cell: int) -> str:
    """A cell in words, with what its residual goes along with most."""
    place = choice.rows.table.cells[cell]
    table, rows = choice.rows.table, place.rows
    deciding = choice.split.deciding[rows]
    values = residual[rows][deciding]
    speed, q, load = (part[rows][deciding] for part in (table.speed_rad_s, table.q_rad, table.load_Nm))
    time = table.t_s[rows][deciding]
    along = {
        "its speed": _binned(values, speed),
        "its angle": _binned(values, q),
        "the torque that it transmits": _binned(values, load),
        "the time since the run began": _binned(values, time),
    }
    name = max(along, key=lambda key: along[key])
    subject = {
        "current_A": "the current that joint {joint}'s motion needs",
        "voltage_as_A": "the voltage of joint {joint}",
        "tip_m": "the tip",
    }[place.channel].format(joint=place.joint + 1)
    if along[name] < 0.1:
        return subject
    if place.joint < 0:
        name = {"its speed": "joint 1's speed", "its angle": "joint 1's angle"}.get(
            name, name.replace("that it", "that joint 1")
        )
        return f"{subject}, changing with {name}"
    return f"{subject}, changing with {name} ({along[name]:.0%} of it)"


def _binned(values: Array, by: Array, bins: int = 16) -> float:
    """Share of the values' square that their means over bins of another quantity take."""
    edges = np.quantile(by, np.linspace(0.0, 1.0, bins + 1)[1:-1])
    index = np.searchsorted(edges, by)
    counts = np.maximum(np.bincount(index, minlength=bins), 1)
    sums = np.bincount(index, weights=values, minlength=bins)
    return float(np.sum(sums**2 / counts) / max(float(values @ values), 1e-12))


def terms_of(steps: Sequence[Step], verdict: Verdict) -> list[Term]:
    """The named terms with the values of the last fit."""
    return [steps[-1].best.fitted.terms[k] for k in verdict.named]


def corrections(steps: Sequence[Step], verdict: Verdict) -> list[Term]:
    """What was found of the sensors, with the values of the last fit."""
    return [steps[-1].best.fitted.terms[k] for k in verdict.corrected]
