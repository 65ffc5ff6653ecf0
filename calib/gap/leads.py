"""Gears seen directly: how far a motor is ahead of its joint, where both have an encoder, by what the gear transmits.

With the joint's own encoder the link's motion is measured, and with it the torque tau that the gear gives it. At each pair of
counts

    lead = a + c (tau + r) + w/2 flank(tau + r) - b q2 + t q'          [rad]

with the compliance c of its spring [rad/(N m)], its play w [rad], the ratio b of a belt that passes joint 3, the time t between
the two counts [s], and the friction r = f sgn(q') on the link, behind the gear, which stays as it was at rest.
flank(x) = tanh(x / (u max |x|)): a link without load may lie on either, so that a pair's variance is that of the counts' steps,
of the moments at which they were made, and w^2/4 (1 - flank^2). f and u are searched; a is one for all runs, or one for each, as
the data say: leads begin anew when drives come on. Nothing is simulated, and no motor's current is needed.

The sets of {c, w, b} are weighed by the Bayesian information criterion (Schwarz, 1978), with as many independent samples as the
autocorrelation of the residuals leaves, and by the prior of a name. An effect is named whose sets have nearly all of the weight,
as everywhere in gap, if they also predict pairs better that were not fitted.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import Array
from calib.gap.effects.catalogue import series_of
from calib.gap.finding import EffectName, NamedEffect
from calib.gap.log import Log, LoggedRun
from calib.gap.posterior.constants import CERTAIN, NAME_PRIOR
from calib.gap.posterior.term import parameters_of
from calib.gap.signals.filters import filters_for
from control.dynamics.dynamics import Dynamics
from control.errors import MissingModel
from control.model.arm import Arm
from control.model.effects import COUPLED, COUPLED_TO

FRICTIONS = (0.0, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.14, 0.2, 0.3, 0.4)  # f, of the largest torque that is transmitted
UNCERTAIN = (0.01, 0.03, 0.1)  # u: within it a flank is not certain
FEWEST = 50  # pairs of counts
LATE_s = 0.007  # within which the motor's board answers, evenly
PASSES = 3  # of a fit: how sure a flank is goes by the play
TURNS_rad_s = 0.02  # as fast as this, friction has its full size


@dataclass(frozen=True, slots=True)
class Pairs:
    """The pairs of one joint (0-based), m over all runs: lead, torque without rotor, speed, angle of joint 2, number of run."""

    joint: int
    lead_rad: Array
    torque_Nm: Array
    speed_rad_s: Array
    direction: Array  # of the last motion: a link that rests is held by friction as it was before
    q2_rad: Array
    run: Array
    begun: Array  # which offset it has
    sd_rad: Array  # by the steps of both encoders, and by the time between the two counts, which varies


@dataclass(frozen=True, slots=True)
class Flank:
    """How a link lies in its gear: the friction behind it [N m], and u."""

    friction_Nm: float
    uncertain: float


@dataclass(frozen=True, slots=True)
class GearFit:
    """A set of effects fitted by least squares: coefficients, their covariance for independent samples, residuals (m,).

    Residuals are in standard deviations of each pair.
    """

    effects: tuple[str, ...]
    flank: Flank
    coefficients: Array
    covariance: Array
    residual: Array
    log_sd: float  # mean logarithm of the pairs' variances

    @property
    def variance(self) -> float:
        """Of the residuals; none for a spring or play below nought, which no gear has."""
        signed = [value for value, effect in zip(self.coefficients, self.effects, strict=False) if effect != "belt_coupling"]
        if any(value <= 0.0 for value in signed):
            return math.inf
        return max(float(np.mean(self.residual**2)), 1e-30) * math.exp(self.log_sd)

    @property
    def independent(self) -> float:
        """How many samples are as good as independent, by the correlation of neighbours."""
        residual = self.residual
        alike = float(residual[1:] @ residual[:-1]) / max(float(residual @ residual), 1e-30)
        alike = min(max(alike, 0.0), 0.999)
        return max(len(residual) * (1.0 - alike) / (1.0 + alike), 2.0)


def gears_by_leads(arm: Arm, log: Log) -> tuple[NamedEffect, ...]:
    """What the leads of a log (columns `lead1_rad` ...) show of the gears between two encoders; nothing where there are none."""
    try:
        dynamics = Dynamics(arm)
    except MissingModel:
        return ()
    named: list[NamedEffect] = []
    for j, drive in enumerate(arm.drives):
        if drive.motor_counts_per_rev is not None and (pairs := _pairs(arm, dynamics, log, j)) is not None:
            named += _named(arm, pairs)
    return tuple(named)


def _pairs(arm: Arm, dynamics: Dynamics, log: Log, joint: int) -> Pairs | None:
    parts = [part for k, run in enumerate(log.runs) for part in _of_run(arm, dynamics, run, joint, k)]
    if sum(len(part[0]) for part in parts) < FEWEST:
        return None
    lead, torque, speed, direction, q2, run = (np.concatenate(column) for column in zip(*parts, strict=True))
    steps_rad = (2.0 * math.pi / counter.counts_per_joint_turn for counter in (arm.drives[joint], arm.drives[joint].at_motor))
    sd_rad = np.sqrt((sum(step**2 for step in steps_rad) + (LATE_s * speed) ** 2) / 12.0)
    return Pairs(joint, lead, torque, speed, direction, q2, run, np.zeros(len(run)), sd_rad)


def _of_run(arm: Arm, dynamics: Dynamics, run: LoggedRun, joint: int, number: int) -> Iterator[tuple[Array, ...]]:
    """Lead, torque, speed, angle of joint 2 and the run's number at each pair, but for the ends, where filters see too little."""
    column = run.extra.get(f"lead{joint + 1}_rad")
    if column is None or len(run) < 3:
        return
    lead_rad = np.array([float(text) if text else math.nan for text in column])
    period_s = float(np.median(np.diff(run.t_s)))
    filters = filters_for(1.0 / period_s)
    t_s = np.arange(run.t_s[0], run.t_s[-1], period_s)
    q, speed, acceleration = filters.states(np.stack([np.interp(t_s, run.t_s, q) for q in run.q_rad.T], axis=1))
    payload_kg = np.interp(t_s, run.t_s, run.payload_kg)
    drive = arm.drives[joint]
    torque = dynamics.torques(q, speed, acceleration, payload_kg)[:, joint]
    torque -= drive.gear_ratio**2 * drive.rotor_inertia_kg_m2 * acceleration[:, joint]
    edge_s = len(filters.state[0]) // 2 * period_s
    is_seen = np.isfinite(lead_rad) & (run.t_s > t_s[0] + edge_s) & (run.t_s < t_s[-1] - edge_s)
    if run.is_commanded:  # off or braked, it may be in a hand or at its end stop: that torque is not the gear's
        is_seen &= np.nan_to_num(run.voltage_V[:, joint]) != 0.0
    seen = np.flatnonzero(is_seen)
    at_s = run.t_s[seen]
    second = q[:, COUPLED_TO - 1] if q.shape[1] >= COUPLED_TO else np.zeros(len(q))
    moves = np.where(np.abs(speed[:, joint]) > TURNS_rad_s, np.sign(speed[:, joint]), 0.0)
    last = np.maximum.accumulate(np.where(moves != 0.0, np.arange(len(moves)), 0))
    beside = (np.interp(at_s, t_s, values) for values in (torque, speed[:, joint], moves[last], second))
    yield lead_rad[seen], *beside, np.full(len(seen), float(number))


def _named(arm: Arm, pairs: Pairs) -> Iterator[NamedEffect]:
    """The effects that stand, with their values from all runs."""
    runs = np.unique(pairs.run)
    is_held_out = np.isin(pairs.run, runs[2::3]) if len(runs) > 2 else _last_third(pairs.run)
    effects = ["joint_compliance", "backlash", *(["belt_coupling"] if pairs.joint == COUPLED - 1 else [])]
    sets = [subset for size in range(len(effects) + 1) for subset in itertools.combinations(effects, size)]
    with_own_offsets = replace(pairs, begun=pairs.run)
    richest = [_best(offsets, sets[-1], ~is_held_out) for offsets in (pairs, with_own_offsets)]
    independent = min(richest, key=lambda fit: fit.variance).independent
    a_value = math.log(independent)
    costs = [independent * math.log(fit.variance) + a_value * len(fit.coefficients) for fit in richest]
    pairs = pairs if costs[0] <= costs[1] else with_own_offsets
    tried = [_best(pairs, subset, ~is_held_out) for subset in sets]
    a_name = a_value - 2.0 * math.log(NAME_PRIOR)
    criteria = np.array([independent * math.log(fit.variance) + a_name * len(fit.effects) for fit in tried])
    weights = np.exp(-0.5 * (criteria - criteria.min()))
    inclusion = {effect: float(weights[[effect in subset for subset in sets]].sum() / weights.sum()) for effect in effects}
    fit = tried[sets.index(tuple(effect for effect in effects if inclusion[effect] >= CERTAIN))]
    before, after = (_predicted_rad(pairs, tried_fit, is_held_out) for tried_fit in (tried[0], fit))
    if not after < before:
        return
    whole = _fit(pairs, fit.effects, fit.flank, np.ones(len(is_held_out), dtype=bool))
    sds = np.sqrt(np.diag(whole.covariance) * len(is_held_out) / whole.independent)
    modelled = {effect.effect: effect.parameters for effect in arm.effects if effect.joint is None}
    for effect, value, sd in zip(fit.effects, whole.coefficients.tolist(), sds.tolist(), strict=False):
        series = series_of(effect)
        if series is None or abs(value) < series.form.smallest:
            continue
        name = EffectName(effect, None if effect == "belt_coupling" else pairs.joint + 1)
        if effect == "belt_coupling":  # the loop has taken off what the file says of it
            value += modelled.get(effect, {}).get("ratio", 0.0)
        parameters = parameters_of(effect)(np.array([value]), np.array([[sd**2]]))
        evidence = {"lead_before_rad": before, "lead_after_rad": after}
        yield NamedEffect(name, parameters, after / before, evidence, inclusion[effect])


def _last_third(run: Array) -> np.ndarray:
    """The later part of each of few runs."""
    is_held_out = np.zeros(len(run), dtype=bool)
    for number in np.unique(run):
        rows = np.flatnonzero(run == number)
        is_held_out[rows[2 * len(rows) // 3 :]] = True
    return is_held_out


def _best(pairs: Pairs, effects: tuple[str, ...], rows: np.ndarray) -> GearFit:
    """The fit with the likeliest flanks."""
    largest_Nm = float(np.abs(pairs.torque_Nm).max())
    flanks = [Flank(share * largest_Nm, u) for share in FRICTIONS for u in UNCERTAIN]
    fits = [_fit(pairs, effects, flank, rows) for flank in (flanks if effects else flanks[:1])]
    return min(fits, key=lambda fit: fit.variance)


def _loaded_Nm(pairs: Pairs, flank: Flank) -> Array:
    return np.asarray(pairs.torque_Nm + flank.friction_Nm * pairs.direction)


def _side(loaded_Nm: Array, flank: Flank) -> Array:
    return np.asarray(np.tanh(loaded_Nm / (flank.uncertain * np.abs(loaded_Nm).max())))


def _columns(pairs: Pairs, effects: Sequence[str], flank: Flank) -> Array:
    """Of the effects, of the counts' moments, and of the offsets: (m, k)."""
    loaded_Nm = _loaded_Nm(pairs, flank)
    laws = {"joint_compliance": loaded_Nm, "backlash": 0.5 * _side(loaded_Nm, flank), "belt_coupling": -pairs.q2_rad}
    offsets = (pairs.begun[:, None] == np.unique(pairs.begun)[None]).astype(np.float64)
    return np.column_stack([*(laws[effect] for effect in effects), pairs.speed_rad_s, offsets])


def _sd_rad(pairs: Pairs, effects: tuple[str, ...], flank: Flank, coefficients: Array) -> Array:
    """Of each pair, with the doubt about its flank: it may lie on the other one, half a play away from where none lies."""
    if "backlash" not in effects:
        return pairs.sd_rad
    half_rad = 0.5 * coefficients[effects.index("backlash")]
    return np.asarray(np.hypot(pairs.sd_rad, half_rad * np.sqrt(1.0 - _side(_loaded_Nm(pairs, flank), flank) ** 2)))


def _fit(pairs: Pairs, effects: tuple[str, ...], flank: Flank, rows: np.ndarray) -> GearFit:
    whole, sd_rad = _columns(pairs, effects, flank), pairs.sd_rad
    for _ in range(PASSES):
        columns, lead = whole[rows] / sd_rad[rows, None], pairs.lead_rad[rows] / sd_rad[rows]
        coefficients, *_ = np.linalg.lstsq(columns, lead, rcond=None)
        residual, used_rad = lead - columns @ coefficients, sd_rad[rows]
        sd_rad = _sd_rad(pairs, effects, flank, coefficients)
    covariance = np.linalg.pinv(columns.T @ columns) * np.mean(residual**2)
    return GearFit(effects, flank, coefficients, covariance, residual, float(np.mean(2.0 * np.log(used_rad))))


def _predicted_rad(pairs: Pairs, fit: GearFit, is_held_out: np.ndarray) -> float:
    """Root mean square of what a fit leaves of pairs that it did not use, about their means where no offset is known."""
    laws = len(fit.effects) + 1  # and the counts' moments
    residual_rad = pairs.lead_rad - _columns(pairs, fit.effects, fit.flank)[:, :laws] @ fit.coefficients[:laws]
    weight, squares = pairs.sd_rad**-2.0 * is_held_out, 0.0
    for offset in np.unique(pairs.begun[is_held_out]):
        run_weight = weight * (pairs.begun == offset)
        squares += float(run_weight @ (residual_rad - run_weight @ residual_rad / run_weight.sum()) ** 2)
    return math.sqrt(squares / float(weight.sum()))
