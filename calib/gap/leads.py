"""Gears seen directly: how far a motor is ahead of its joint, where both have an encoder, as a channel of the posterior.

With the joint's own encoder the link's motion is measured, and with it the torque tau that the gear gives it. A pair of counts is
then like a pose whose gear carries tau in place of gravity's torque alone, and

    lead = a - s x + q' t + noise          [rad],

with the laws s of a spring, a play and a belt that poses have too: their sizes x, every friction behind the gear that lays it on
other flanks, and how sure each flank is (`effects/gear.py`, `effects/encoder.py`). Free beside them are the offset a of each run,
as leads begin anew when drives come on, and the time t between the two counts. No other channel sees these effects of a joint
whose encoder is behind its gear, and no lead sees another joint's: the evidence of its leads is all there is of a gear, and sets
are weighed as everywhere. The noise of a pair is that of the counts' steps and moments, of the flank that it may not lie on, and
of friction, which holds a soft gear anywhere in its band; what is left is whitened as rows of time series are
(`residuals/whitening.py`). No motor's current is needed.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, rms
from calib.gap.effects.catalogue import pose_terms, series_of
from calib.gap.effects.record import PoseScene
from calib.gap.finding import EffectName, NamedEffect, as_total
from calib.gap.log import Log, LoggedRun
from calib.gap.posterior.constants import FLOOR_DOUBT
from calib.gap.posterior.decide import decide, estimated, nameable
from calib.gap.posterior.evidence import Evidence, Gram, Member
from calib.gap.posterior.search import Search
from calib.gap.residuals.rows import SLOW_rad_s
from calib.gap.residuals.whitening import Noise, RowOrder, fitted
from calib.gap.signals.filters import filters_for
from calib.points.points import make_points
from control.dynamics.static_pose import moving_Nm, resting
from control.errors import MissingModel
from control.model.arm import Arm

GEARS = ("joint_compliance", "backlash", "belt_coupling")
LATE_s = 0.007  # within which the motor's board answers, evenly


@dataclass(frozen=True, slots=True)
class Pairs:
    """The m pairs of counts of a joint, run after run, and how the arm moves at them.

    `lead_rad` (m,) with the deviation `sd_rad` of its steps and moments, in `order`; `free` (m, k): what is in every lead
    besides; `scene`: the arm at them, its encoder taken to be the motor's.
    """

    lead_rad: Array
    sd_rad: Array
    order: RowOrder
    free: Array
    scene: PoseScene

    @classmethod
    def of(cls, arm: Arm, log: Log, j: int) -> Pairs | None:
        """Of joint j (0-based); None where no motion has any."""
        parts = [part for number, run in enumerate(log.runs) for part in _of_run(run, j, number)]
        if not parts:
            return None
        lead, at, q, speed, acceleration, last, payload = map(np.concatenate, zip(*parts, strict=True))
        run, sample = at.T.astype(np.intp)
        drive, motor = arm.drives[j], arm.drives[j].at_motor
        steps_rad = [2.0 * math.pi / one.counts_per_joint_turn for one in (drive, motor)]
        sd = np.sqrt((sum(step**2 for step in steps_rad) + (LATE_s * speed[:, j]) ** 2) / 12.0)
        kept = tuple(one for one in arm.effects if one.effect not in GEARS)
        bare = dataclasses.replace(
            arm, drives=tuple(motor if one is drive else one for one in arm.drives), effects=kept
        )
        nowhere, names = np.full((len(q), 3), np.nan), [str(k) for k in range(len(q))]
        points = make_points(names, names, [1] * len(q), q, nowhere, last, payload_kg=payload)
        moving = moving_Nm(bare, q, speed, acceleration, payload)
        scene = PoseScene(bare, bare, points, q, resting(bare, q, last, None, payload, moving))
        order = RowOrder.of(run, sample, int(np.median(np.diff(sample))), 1)
        offsets = run[:, None] == np.unique(run)
        return cls(lead, sd, order, np.column_stack((speed[:, j], offsets)), scene)

    def gram(self, columns: Array, variance: Array, noise: Noise) -> Gram:
        """What evidence needs of columns (m, c), where pairs have a variance (m,)."""
        count = self.free.shape[1]
        rows = np.column_stack((self.free, columns, self.lead_rad)) / np.sqrt(variance)[:, None]
        white = self.order.whitened(rows, noise)
        base, rest = np.linalg.qr(white[:, :count])[0], white[:, count:]
        rest -= base @ (base.T @ rest)
        seen = rest.T @ rest
        none = np.zeros_like(seen)[:-1]
        freedom = float(len(rows) - count)
        return Gram(seen[:-1, :-1], seen[:-1, -1], none[:, :-1], none[:, -1], float(seen[-1, -1]), freedom)

    def left_rad(self, moved_rad: Array, variance: Array) -> Array:
        """What moves (m,) and what is free leave of the leads, (m,)."""
        left, weight = self.lead_rad - moved_rad, variance**-0.5
        return np.asarray(left - self.free @ np.linalg.lstsq(weight[:, None] * self.free, weight * left)[0])


def _of_run(run: LoggedRun, j: int, number: int) -> Iterator[tuple[Array, ...]]:
    """Lead, run, sample, angles, speeds, accelerations, last directions and payload at each pair, but for the ends, where filters
    see too little.
    """
    column = run.extra.get(f"lead{j + 1}_rad")
    if column is None or len(run) < 3:
        return
    lead_rad = np.array([float(text) if text else math.nan for text in column])
    period_s = float(np.median(np.diff(run.t_s)))
    filters = filters_for(1.0 / period_s)
    t_s = np.arange(run.t_s[0], run.t_s[-1], period_s)
    states = filters.states(np.stack([np.interp(t_s, run.t_s, q) for q in run.q_rad.T], axis=1))
    edge_s = len(filters.state[0]) // 2 * period_s
    is_seen = np.isfinite(lead_rad) & (run.t_s > t_s[0] + edge_s) & (run.t_s < t_s[-1] - edge_s)
    # off or braked, it may be in a hand or at its end stop: that torque is not the gear's
    if run.is_commanded:
        is_seen &= np.nan_to_num(run.voltage_V[:, j]) != 0.0
    seen = np.flatnonzero(is_seen)
    moves = np.where(np.abs(states[1]) > SLOW_rad_s, np.sign(states[1]), 0.0)
    at_last = np.maximum.accumulate(np.where(moves != 0.0, np.arange(len(moves))[:, None], 0), axis=0)
    # a link that rests is held by friction as it was before
    last = np.take_along_axis(moves, at_last, axis=0)

    def at(values: Array) -> Array:
        return np.stack([np.interp(run.t_s[seen], t_s, one) for one in values.T], axis=1)

    if len(seen):
        which = np.column_stack((np.full(len(seen), float(number)), seen))
        yield lead_rad[seen], which, *map(at, states), np.sign(at(last)), run.payload_kg[seen]


def gears_by_leads(arm: Arm, log: Log) -> tuple[NamedEffect, ...]:
    """What the leads of a log (columns `lead1_rad` ...) show of the gears between two encoders; nothing where there are none."""
    try:
        found = [
            (j, pairs)
            for j, drive in enumerate(arm.drives)
            if drive.motor_counts_per_rev is not None and (pairs := Pairs.of(arm, log, j)) is not None
        ]
    except MissingModel:
        return ()
    return tuple(name for j, pairs in found for name in _named(arm, pairs, j))


def _named(arm: Arm, pairs: Pairs, j: int) -> Iterator[NamedEffect]:
    """The effects of the gear of joint j (0-based) that stand, with their totals."""
    shown = [one for one in pose_terms(pairs.scene, GEARS) if getattr(one.key, "acts_on", None) == j + 1]
    terms = [one.law_alone() for one in shown]  # a play that grows with the load is a spring to any lead
    columns = -np.concatenate([one.slope_rad[:, :, j] for one in terms if one.slope_rad is not None]).T
    held = 0.0 if pairs.scene.pose is None else pairs.scene.pose.held_Nm[:, j] ** 2
    wavers = [
        held * (one.key == EffectName("joint_compliance", j + 1)) if one.doubt is None else one.doubt
        for one in terms
    ]

    def variance(sizes: Mapping[int, Array]) -> Array:
        """Of every pair, (m,), beside effects of these sizes by their terms' numbers."""
        moved = (wavers[k] * (terms[k].size * size[0]) ** 2 for k, size in sizes.items())
        return np.asarray(sum(moved, pairs.sd_rad**2))

    noise, tried = Noise.white(int(pairs.order.run[-1]) + 1), set[tuple[Member, ...]]()
    usual = variance({k: np.ones(1) for k in {one.key: k for k, one in enumerate(terms)}.values()})
    before, own_variance = rms(pairs.left_rad(np.zeros(len(columns)), usual)), usual
    while True:
        evidence = Evidence(pairs.gram(columns, own_variance, noise), terms, FLOOR_DOUBT)
        apart = {one.name: one.confusable_with for one in nameable(evidence)}
        decision = decide(evidence, Search(evidence).run(), apart)
        sizes, moved = evidence.sizes(decision.best), np.zeros(len(columns))
        for number, size in sizes.items():
            moved += columns[:, evidence.places[number]] @ size
        own_variance = variance(sizes)
        left = pairs.left_rad(moved, own_variance)
        noise = fitted(pairs.order, left / np.sqrt(own_variance), np.ones(len(left), dtype=bool))
        if decision.best.members in tried:
            break
        tried.add(decision.best.members)
    for name in decision.names:
        own, series = estimated(evidence, decision.best, name), series_of(name.effect)
        if series is None or float(np.linalg.norm(own.value)) < series.form.smallest:
            continue
        # of a belt the loop has taken off what the file says
        known = [one for one in arm.effects if name.joint is None and one.effect == name.effect]
        parameters = as_total(name.effect, known[0].parameters, own.parameters) if known else own.parameters
        yield NamedEffect(
            name, parameters, rms(left) / before, {"lead_before_rad": before, "lead_after_rad": rms(left)},
            decision.probability[name],
        )  # fmt: skip
