"""A log of the runtime, and the tips that a motion capture system has seen of the same motion, on one clock.

A row of a log holds angles that are older than the row: by the period of the board's reports and by the way of a report to
the host. The boards' time stamps (columns counted1_s ...) say when each was latched, currents and voltages how old that is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.arrays import Array, frozen
from calib.capture.alignment import JointMotion, after_leaps, begins_s
from calib.gap.log import Log, LoggedRun
from control.model.arm import Arm
from procedures.gap.timing import Clocks, Frames, Raw, aligned, clocks_of, tips_at_rows

LEAST_ROWS = 10
STRAY_s, DRIFT = 0.05, 1e-3  # of a board's clock against the loop's: late reports, and two crystals
NO_STAMPS = (
    "the log has no time stamps of the encoder boards (counted1_s ...): times are those of its rows, whose angles are"
    " older"
)


def on_one_clock(arm: Arm, log: Log, run: str | None) -> tuple[Log, tuple[str, ...]]:
    """The log (or one run of it) with the angles, currents and voltages that belong to each row's time, and what was done."""
    runs = [one for one in log.runs if run is None or one.name == run]
    raws = [_raw(one, begin_s, arm.joint_count) for one, begin_s in zip(runs, begins_s(runs), strict=True)]
    stamped = [raw for raw in raws if raw is not None]
    if not stamped or len(stamped) < len(raws):
        return replace(log, runs=tuple(runs)), (NO_STAMPS,)
    clocks = clocks_of(arm, stamped)
    pairs = zip(runs, stamped, strict=True)
    return replace(log, runs=tuple(_placed(arm, one, raw, clocks) for one, raw in pairs)), clocks.in_words()


def with_tips(arm: Arm, log: Log, motion: JointMotion, seen_s: Array, tip_m: Array) -> Log:
    """The log with tips (k, 3) in the base frame, seen at times (k,) of its clock."""
    inside = np.isfinite(tip_m).all(axis=1) & (motion.covers(seen_s) > 0.0)
    frames = Frames(seen_s[inside], tip_m[inside], *motion.at(seen_s[inside]))
    starts = begins_s(log.runs)
    return replace(
        log,
        runs=tuple(
            replace(one, tip_m=frozen(tips_at_rows(arm, one.t_s + begin_s, frames)))
            for one, begin_s in zip(log.runs, starts, strict=True)
        ),
    )


def _raw(run: LoggedRun, begin_s: float, joint_count: int) -> Raw | None:
    """As the runtime recorded it; None without time stamps that follow the log's clock. What is before homing says nothing."""
    columns = [run.extra.get(f"counted{j}_s") for j in range(1, joint_count + 1)]
    first = after_leaps(run.t_s, run.q_rad)
    if len(run) - first < LEAST_ROWS or any(column is None for column in columns):
        return None
    counted_s = np.column_stack([_numbers(column or ()) for column in columns])[first:]
    t_s = run.t_s[first:] + begin_s
    ahead_s = t_s[:, None] - counted_s
    if not (np.ptp(ahead_s, axis=0) < STRAY_s + DRIFT * np.ptp(t_s)).all():
        return None
    kept = run.rows(slice(first, None))
    return Raw(
        t_s, kept.q_rad, kept.q_set_rad, kept.current_A, kept.voltage_V, counted_s, kept.tip_m, kept.payload
    )


def _numbers(texts: Sequence[str]) -> Array:
    """NaN for what is none."""
    try:
        return np.array([float(text or "nan") for text in texts])
    except ValueError:
        return np.full(len(texts), np.nan)


def _placed(arm: Arm, run: LoggedRun, raw: Raw, clocks: Clocks) -> LoggedRun:
    """The rows of a run that have one before and one after them."""
    found, kept = aligned(arm, raw, clocks), run.rows(slice(len(run) - len(raw.t_s) + 1, -1))
    return replace(
        kept,
        q_rad=frozen(found.q_rad),
        current_A=frozen(found.current_A),
        voltage_V=frozen(found.voltage_V),
        tip_m=frozen(found.tip_m),
    )
