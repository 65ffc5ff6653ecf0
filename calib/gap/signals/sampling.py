"""What the time stamps and the samples of a log say of how it was sampled.

A period is a span over its samples: the differences of stamps are rounded to what was printed, or, counted in seconds since 1970,
to a quarter of a microsecond, and a median of rounded figures adds up to milliseconds over a run. Samples that were computed from
others (a log brought to another rate) lie on straight lines between them, or repeat them: they are taken out again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from calib.arrays import Array, frozen
from calib.gap.log import LoggedRun

GAP = 2.5  # periods between samples: more is a gap, and its neighbourhood is not used
ONE_RATE = 0.1  # by which runs of one controller may differ
# Of an interpolation that is undone, as 500 a second brought to 1000; the largest first, as one by 4 is one by 2 as well.
FACTORS = range(10, 1, -1)
# Bends of computed samples over those of measured ones: nothing but the rounding of what was printed. Those of measured samples
# alone are alike in every phase.
COMPUTED = 0.15
# Share of samples whose currents lie on the line between their neighbours to a twentieth of what is usual, on all joints at
# once: of measured currents one joint shows 4 % of them, three joints less than one in ten thousand. A log with fewer than twice
# as many samples as were measured has no such ones.
FAST_Hz = 800.0  # an arm's equations are looked at up to 60 Hz: faster sampling costs time and tells nothing
ROUNDED = 0.75  # of a stamp's last digit: half of it, and what the line through them is uncertain by
ON_A_LINE, ON_A_LINE_SHARE = 0.05, 0.15


def period_of(runs: Sequence[LoggedRun]) -> float:
    """The sampling period [s]: the span of the samples over how many there are; lost samples count, gaps do not.

    A stamp that is late is followed by one that seems early: together they are two periods.
    """
    steps = np.concatenate([np.diff(run.t_s) for run in runs])
    usual = float(np.median(steps))
    near = steps[steps < GAP * usual]
    return float(near.sum() / max(np.round(near / usual).sum(), 1.0))


def common_period(runs: Sequence[LoggedRun]) -> tuple[float, str]:
    """The period that all runs are brought to, that of the slowest, and a sentence where they differ."""
    own = np.array([period_of([run]) for run in runs])
    if own.max() < (1.0 + ONE_RATE) * own.min():
        return period_of(runs), ""
    return float(own.max()), (
        f"the runs have {1.0 / own.max():.4g} to {1.0 / own.min():.4g} samples a second: all are brought to the fewest"
    )


def evened(run: LoggedRun, period_s: float) -> LoggedRun:
    """The same at the times at which it was sampled, where its stamps are these times rounded; else unchanged."""
    steps = np.diff(run.t_s)
    if len(steps) < 3 or steps.max() > GAP * period_s:
        return run
    count = np.concatenate(([0.0], np.cumsum(np.maximum(np.round(steps / period_s), 1.0))))
    slope, first = np.polyfit(count - count.mean(), run.t_s - run.t_s[0], 1)
    line = run.t_s[0] + first + slope * (count - count.mean())
    if float(np.abs(line - run.t_s).max()) > ROUNDED * _quantum_s(steps) + np.spacing(float(run.t_s[-1])):
        return run
    return dataclasses.replace(run, t_s=frozen(line))


def _quantum_s(steps: Array) -> float:
    """What stamps are rounded to: the least difference between two of their differences; 0 where all are alike."""
    different = np.diff(np.unique(np.round(steps, 9)))
    return float(different.min()) if len(different) else 0.0


def measured(runs: Sequence[LoggedRun]) -> tuple[tuple[LoggedRun, ...], str]:
    """The runs without samples that were computed from others, and a sentence about these, if there are any."""
    for factor in FACTORS:
        for differences, words in ((1, "repeats the one before"), (2, "lies on the line between others")):
            phases = [_phase(run, factor, differences) for run in runs]
            # a run that moves and shows no such phase says otherwise
            still = [not np.ptp(run.q_rad, axis=0).max() > 0.0 for run in runs]
            told = [phase is not None for phase in phases]
            if any(told) and all(one or other for one, other in zip(told, still, strict=True)):
                kept = tuple(run.rows(slice(phase or 0, None, factor)) for run, phase in zip(runs, phases, strict=True))
                rate_Hz = 1.0 / period_of(kept)
                return kept, (
                    f"{factor - 1} of {factor} samples {words}: the log was brought from {rate_Hz:.4g} to"
                    f" {factor * rate_Hz:.4g} samples a second; only the measured ones are used"
                )
    return tuple(runs), ""


def _phase(run: LoggedRun, factor: int, differences: int) -> int | None:
    """The first sample of those that were measured, if one in `factor` was; None if not."""
    if len(run) < 8 * factor:
        return None
    columns = [run.q_rad, run.current_A] if np.isfinite(run.current_A).all() else [run.q_rad]
    bends = np.abs(np.diff(np.hstack(columns), differences, axis=0))
    bends = (bends / np.maximum(bends.mean(axis=0), 1e-300)).sum(axis=1)  # each column counts the same
    by_phase = np.array([bends[first::factor].mean() for first in range(factor)])
    top = int(np.argmax(by_phase))
    if by_phase[top] == 0.0 or np.delete(by_phase, top).max() > COMPUTED * by_phase[top]:
        return None
    return (top + 1) % factor


def averaged(runs: Sequence[LoggedRun]) -> tuple[tuple[LoggedRun, ...], str, int]:
    """Fast runs without voltages as means of a few samples, a sentence about it, and how many: what an arm does is far slower.

    Runs with voltages stay as they are: what was held between the samples cannot be averaged.
    """
    rate_Hz = 1.0 / period_of(runs)
    factor = int(rate_Hz / FAST_Hz)
    factor -= 1 - factor % 2  # odd, so that a mean stands at a sample
    if factor < 3 or any(run.is_commanded or np.isfinite(run.voltage_V).any() for run in runs):
        return tuple(runs), "", 1
    return (
        tuple(_averaged(run, factor) for run in runs),
        f"{rate_Hz:.0f} samples a second, without voltages: means of {factor} are used",
        factor,
    )


def _averaged(run: LoggedRun, factor: int) -> LoggedRun:
    """Means about every `factor`-th sample, those on which most camera frames fall."""
    frames = np.flatnonzero(np.isfinite(run.tip_m[:, 0])) % factor
    middle = int(np.bincount(frames, minlength=factor).argmax()) if len(frames) else factor // 2
    places = np.arange(middle, len(run), factor)
    places = places[(places >= factor // 2) & (places + factor // 2 < len(run))]
    about = places[:, None] + np.arange(-(factor // 2), factor // 2 + 1)
    thin = run.rows(places)
    return dataclasses.replace(
        thin,
        q_rad=frozen(run.q_rad[about].mean(axis=1)),
        q_set_rad=frozen(run.q_set_rad[about].mean(axis=1)),
        current_A=frozen(run.current_A[about].mean(axis=1)),
    )


def is_resampled(currents: Sequence[Array]) -> bool:
    """Whether many samples of the currents, (m, n) of each run, were computed from their neighbours, at whatever rate."""
    flags = []
    for current in currents:
        steps, bend = np.abs(np.diff(current, axis=0)), np.abs(np.diff(current, 2, axis=0))
        usual = np.sqrt(np.mean(bend**2, axis=0))
        finest = np.array([own[own > 0.0].min(initial=np.inf) for own in steps.T])
        if (usual * ON_A_LINE > finest).all():  # coarser ones are on a line by their rounding
            flags.append((bend < ON_A_LINE * usual).all(axis=1))
    return bool(flags) and float(np.mean(np.concatenate(flags))) > ON_A_LINE_SHARE
