"""Runs made ready: a constant rate, filtered motion, what may be used of each sample, and what was recognised."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from calib.arm_problem.assembly import base_frame_of
from calib.arrays import Array, frozen
from calib.errors import CalibrationError
from calib.gap.log import Log, LoggedRun
from calib.gap.signals.filters import Filters, filters_for
from calib.gap.signals.sampling import GAP, averaged, common_period, evened, measured, period_of
from control.model.arm import Arm

Flags = npt.NDArray[np.bool_]
JITTER = 0.02  # of the period: less is the clock's printing
SOUND_LEAST = 0.3  # of the samples must not lie in or beside gaps: else these are events, and no time series
BESIDE_GAP_s = 0.04  # the reach of a row's filter
UNEVEN_SHARE = 0.01  # of the samples: fewer are lost ones, and not worth a word
SINCE_1970_s = 1e8  # three years: no clock that began with the arm
AT_LIMIT = 0.985  # of the current limit
ANOTHER_UNIT = 1.5  # times a limit
SHORTEST_s = 0.5
SETTLING_s = 1.5  # how the arm came to rest before a run is not known: what it rings with has gone by then
SETTLING_SHARE = 0.2  # of a run at most
NAMES_MOST = 4  # of runs in a sentence


class UnusableLogError(CalibrationError):
    """The log is well-formed, but nothing can be concluded from it; says why and what would help."""


@dataclass(frozen=True, slots=True)
class EvenRun:
    """A run at a constant rate: (m, n) arrays; `usable` (m, n) says which samples count.

    q, speed, acceleration and current are state-filtered; voltage_V is as commanded (0 where the driver is off),
    `is_off` where it is. `frames` are the samples that the camera saw, tip_m (frames, 3) in the base frame as the arm's file has
    it; q_raw, current_raw_A (m, n).
    """

    name: str
    t_s: Array
    q_raw: Array
    current_raw_A: Array
    q: Array
    speed: Array
    acceleration: Array
    current_A: Array
    current_slope: Array
    voltage_V: Array
    is_off: Flags
    payload_kg: Array
    usable: Flags
    frames: npt.NDArray[np.intp]
    tip_m: Array

    def __len__(self) -> int:
        """How many samples."""
        return len(self.t_s)


@dataclass(frozen=True, slots=True)
class RunSet:
    """All runs, which repeat each other, and sentences about what is wrong with them.

    `held_s` (n,): how long a voltage is held: the controller's own sampling period, where samples were averaged afterwards;
    drives that close the loop themselves hold it for far less, which is nought here.
    """

    runs: tuple[EvenRun, ...]
    repeats: tuple[tuple[int, ...], ...]
    filters: Filters
    has_current: bool
    has_voltage: bool
    has_tip: bool
    warnings: tuple[str, ...]
    held_s: Array


def prepare(arm: Arm, log: Log) -> RunSet:
    """Return the recording of this arm; UnusableLogError if it cannot be one."""
    _check(arm, log)
    kept, warnings = _long_enough(log)
    warnings += [*_about_angles(arm, log), *_about_inertia(arm)]
    kept, copies = _without_copies(kept)
    warnings += copies
    given, said, averaged_count = _as_sampled([_from_its_beginning(run) for run in kept])
    warnings += said
    repeats = Log(given).repeats()
    period, rates = common_period(given)
    filters = filters_for(1.0 / period)
    warnings += [*_about_gaps(given, period), *([rates] if rates else _about_steps(given, period))]
    warnings += _saturation(arm, given)
    _require_a_rate(given, period)
    runs = tuple(_motion(arm, run, filters, period) for run in given)
    if len(runs) > 1 and all(len(group) == 1 for group in repeats):
        warnings.append("no run repeats another: the noise floor comes from what the filters take off")
    if len(runs) == 1:
        warnings.append("one run only: nothing can be held out from it but its later parts")
    has_current = all(np.isfinite(run.current_A).all() for run in given)
    has_voltage = all(run.is_commanded or np.isfinite(run.voltage_V).any() for run in given)
    has_tip = all(len(run.frames) > 20 for run in runs)
    held_s = np.array([(drive.pid.mode != "position") * period / averaged_count for drive in arm.drives])
    return RunSet(runs, repeats, filters, has_current, has_voltage, has_tip, tuple(warnings), held_s)


def _long_enough(log: Log) -> tuple[list[LoggedRun], list[str]]:
    """The runs that are long enough, and a sentence about the others."""
    kept = [run for run in log.runs if run.t_s[-1] - run.t_s[0] >= SHORTEST_s]
    if not kept:
        raise UnusableLogError(f"log: every run is shorter than {SHORTEST_s} s: expected recordings of seconds")
    short = [run.name for run in log.runs if run.t_s[-1] - run.t_s[0] < SHORTEST_s]
    return kept, [f"{_runs(short)}: shorter than {SHORTEST_s} s, not used"] if short else []


def _about_inertia(arm: Arm) -> list[str]:
    """A sentence about links with a mass and no inertia, which no body is."""
    bare = [
        str(k + 1)
        for k, link in enumerate(arm.links)
        if link.mass_kg and link.inertia_kg_m2 is not None and max(link.inertia_kg_m2) <= 0.0
    ]
    if not bare:
        return []
    return [
        f"arm {arm.name}: inertia_kg_m2 of link {', '.join(bare)} is zero, which no body has: what accelerations show of it may"
        " be named link_inertia, or hide what is small"
    ]


def _without_copies(runs: Sequence[LoggedRun]) -> tuple[list[LoggedRun], list[str]]:
    """Each recording once, and a sentence about those that are there again: copies repeat nothing."""
    kept: list[LoggedRun] = []
    copies = []
    for run in runs:
        if any(_is_copy(run, other) for other in kept):
            copies.append(run.name)
        else:
            kept.append(run)
    what = "a copy of another" if len(copies) == 1 else "copies of others"
    return kept, [f"{_runs(copies)}: {what}, used once"] if copies else []


def _is_copy(run: LoggedRun, other: LoggedRun) -> bool:
    """Whether all that was measured is the same: to the last digit nothing is measured twice."""
    if len(run) != len(other) or not np.array_equal(run.q_rad, other.q_rad):
        return False
    pairs = ((run.current_A, other.current_A), (run.tip_m, other.tip_m))
    measured = [(one, two) for one, two in pairs if np.isfinite(one).any()]
    return bool(measured) and all(np.array_equal(one, two, equal_nan=True) for one, two in measured)


def _as_sampled(runs: Sequence[LoggedRun]) -> tuple[tuple[LoggedRun, ...], list[str], int]:
    """Samples that were measured, at their times, as many as are looked at; sentences about that; how many a mean is of."""
    given, computed = measured(runs)
    given, fast, count = averaged(tuple(evened(run, period_of([run])) for run in given))
    part, long = part_of(Log(given))
    return part.runs, [sentence for sentence in (computed, fast, long) if sentence], count


def _from_its_beginning(run: LoggedRun) -> LoggedRun:
    """A run whose clock counts from 1970 begins at 0: when the arm was started, such a clock does not say."""
    if run.t_s[0] < SINCE_1970_s:
        return run
    return replace(run, t_s=frozen(run.t_s - run.t_s[0]))


def _runs(names: Sequence[str]) -> str:
    """As `run 3`, or `4 runs (1, 2, 5 and others)`."""
    if len(names) == 1:
        return f"run {names[0]}"
    return f"{len(names)} runs ({', '.join(names[:NAMES_MOST])}{' and others' if len(names) > NAMES_MOST else ''})"


def _check(arm: Arm, log: Log) -> None:
    if log.joint_count != arm.joint_count:
        raise UnusableLogError(
            f"log: {log.joint_count} joints, but arm {arm.name} has {arm.joint_count}: is it another arm's log?"
        )
    missing = [j for j in range(1, arm.joint_count + 1) if all(d.joint != j for d in arm.drives)]
    if missing:
        raise UnusableLogError(
            f"arm {arm.name}: no [[drive]] of joint {missing[0]}: currents and voltages say nothing without motor and gear;"
            " torques of the joints do (--current-unit Nm)"
        )


def _about_angles(arm: Arm, log: Log) -> Iterator[str]:
    """Angles beyond the limits. Joints that turn on and on have none, and a servo may leave its limits a little.

    UnusableLogError for what looks like degrees and spans more than the joint can turn.
    """
    for drive in arm.drives:
        angles = np.concatenate([run.q_rad[:, drive.joint - 1] for run in log.runs])
        if np.isfinite([drive.joint_lower_rad, drive.joint_upper_rad]).all():
            yield from _beyond(drive.joint, angles, drive.joint_lower_rad, drive.joint_upper_rad)


def _beyond(joint: int, q: Array, lower: float, upper: float) -> Iterator[str]:
    margin = 0.5 + 0.1 * (upper - lower)
    low, high = float(q.min()), float(q.max())
    if low >= lower - margin and high <= upper + margin:
        return
    in_degrees = np.deg2rad(low) >= lower - margin and np.deg2rad(high) <= upper + margin
    goes = f"q{joint}_rad goes from {low:.3g} to {high:.3g}, joint {joint} from {lower:.3g} to {upper:.3g} rad"
    remedy = "if the joint turns that far, correct joint_lower_rad and joint_upper_rad in arm.toml"
    if in_degrees and max(abs(low), abs(high)) > 4.0:
        if high - low > upper - lower:
            raise UnusableLogError(f"log: {goes}: these look like degrees; {remedy}")
        yield f"{goes}: degrees? {remedy}"
    else:
        yield f"{goes}: another arm's log? {remedy}"


def _motion(arm: Arm, run: LoggedRun, filters: Filters, period: float) -> EvenRun:
    times, sound = _grid(run, period)

    def at(values: Array) -> Array:
        """Linear between samples; the columns of a run without jitter or gap are left as they are."""
        if len(times) == len(run.t_s) and np.allclose(times, run.t_s, atol=JITTER * period, rtol=0.0):
            return np.array(values)
        return np.stack([np.interp(times, run.t_s, column) for column in values.T], axis=1)

    q_raw = at(run.q_rad)
    q, speed, acceleration = filters.states(q_raw)
    current_raw = at(np.nan_to_num(run.current_A))
    current, slope, _ = filters.states(current_raw)
    held = np.searchsorted(run.t_s, times + 0.5 * period * JITTER, side="right") - 1
    voltage = run.voltage_V[np.clip(held, 0, len(run) - 1)]
    is_limited = _limited(arm, run)[np.clip(held, 0, len(run) - 1)]
    reach = (len(filters.state[0]) - 1) // 2
    usable = sound[:, None] & ~spread(is_limited, reach)
    usable[: round(min(SETTLING_s, SETTLING_SHARE * (times[-1] - times[0])) / period)] = False
    usable[-reach:] = False  # behind the end the motion goes on, and nobody knows how
    seen = np.flatnonzero(np.isfinite(run.tip_m[:, 0]))
    frames = np.clip(np.round((run.t_s[seen] - times[0]) / period).astype(np.intp), 0, len(times) - 1)
    good = (np.abs(times[frames] - run.t_s[seen]) < 0.05 * period) & usable[frames].all(axis=1)
    return EvenRun(
        run.name,
        times,
        q_raw,
        current_raw,
        q,
        speed,
        acceleration,
        current,
        slope,
        np.nan_to_num(voltage),
        np.isnan(voltage),
        run.payload_kg[np.clip(held, 0, len(run) - 1)],
        usable,
        frames[good],
        base_frame_of(arm).to_base(run.tip_m[seen[good]]),
    )


def _grid(run: LoggedRun, period: float) -> tuple[Array, Flags]:
    """Equal steps over the run, and which of them are not in or beside a gap."""
    count = round(float(run.t_s[-1] - run.t_s[0]) / period) + 1
    times = run.t_s[0] + period * np.arange(count)
    sound = np.ones(count, dtype=bool)
    for k in _gaps(run, period):
        sound &= ~((times > run.t_s[k] - BESIDE_GAP_s) & (times < run.t_s[k + 1] + BESIDE_GAP_s))
    return times, sound


def _require_a_rate(runs: Sequence[LoggedRun], period: float) -> None:
    """UnusableLogError for samples that come when something happens: between them nothing is known of a motion."""
    share = float(np.mean(np.concatenate([_grid(run, period)[1] for run in runs])))
    if share < SOUND_LEAST:
        steps = np.concatenate([np.diff(run.t_s) for run in runs])
        raise UnusableLogError(
            f"log: only {share:.0%} of the time has samples at a rate: they lie {1e3 * steps.min():.3g} ms to {steps.max():.3g} s"
            " apart, as events do and time series do not: record every cycle of the controller, as it comes"
        )


def _gaps(run: LoggedRun, period: float) -> npt.NDArray[np.intp]:
    """The last sample before each gap."""
    return np.flatnonzero(np.diff(run.t_s) > GAP * period)


def _about_gaps(runs: Sequence[LoggedRun], period: float) -> Iterator[str]:
    """One sentence about all gaps."""
    found = {run.name: _gaps(run, period) for run in runs}
    count = sum(map(len, found.values()))
    if count:
        worst = max(runs, key=lambda run: float(np.diff(run.t_s).max()))
        steps = np.diff(worst.t_s)
        yield (
            f"{_runs([name for name, gaps in found.items() if len(gaps)])}: {count} gaps, the longest {steps.max():.3f} s in run"
            f" {worst.name} at {worst.t_s[int(steps.argmax())]:.3f} s: the samples around them are not used"
        )


def _about_steps(runs: Sequence[LoggedRun], period: float) -> Iterator[str]:
    """One sentence about all samples that are not a period apart."""
    shares = {}
    for run in runs:
        steps = np.delete(np.diff(run.t_s), _gaps(run, period))
        shares[run.name] = float(np.mean(np.abs(steps - period) > JITTER * period))
    uneven = {name: share for name, share in shares.items() if share > UNEVEN_SHARE}
    if uneven:
        yield (
            f"{_runs(list(uneven))}: up to {max(uneven.values()):.0%} of the samples are not {1e3 * period:.4g} ms apart:"
            " interpolated"
        )


def _limited(arm: Arm, run: LoggedRun) -> Flags:
    """Where a drive's current or voltage is at its limit."""
    flags = np.zeros(run.q_rad.shape, dtype=bool)
    for drive in arm.drives:
        j = drive.joint - 1
        with np.errstate(invalid="ignore"):
            # Far beyond its limit is no drive: that is another unit.
            current = np.abs(run.current_A[:, j]) / drive.current_limit_A
            voltage = np.abs(run.voltage_V[:, j]) / drive.supply_V
            flags[:, j] |= (current >= AT_LIMIT) & (current < ANOTHER_UNIT)
            flags[:, j] |= (voltage > 1.0001) & (voltage < ANOTHER_UNIT)
    return flags


def _saturation(arm: Arm, runs: Sequence[LoggedRun]) -> Iterator[str]:
    """One sentence a drive that is at its limit somewhere."""
    shares = [_limited(arm, run).mean(axis=0) for run in runs]
    for drive in arm.drives:
        own = {run.name: share[drive.joint - 1] for run, share in zip(runs, shares, strict=True)}
        worst = max(own, key=lambda name: own[name])
        if own[worst] > 0.0:
            count = sum(share > 0.0 for share in own.values())
            yield (
                f"drive {drive.joint} is at its limit in {count} runs (run {worst}: {own[worst]:.2%} of the samples):"
                " those samples are not used"
            )


def spread(flags: Flags, reach: int) -> Flags:
    """True within `reach` samples of a true one."""
    ones = np.ones(2 * reach + 1)
    columns = [np.convolve(column, ones, "same") > 0.5 for column in flags.T]
    return np.stack(columns, axis=1)


# A part of a long log that says what the whole does: blocks of its runs, spread over loads and speeds, repeats together.
# What an answer in half a minute can look at, on two cores: eleven runs of 8 s are 44 000 samples. Every joint counts.
MOST_SAMPLES = 66_000 * 3
LEAST_s = 15.0  # of a log, however fast it was sampled
BLOCK_s = 10.0  # of a run that is longer: several motions, and a fifth of it to forget how it began
TWICE = 2  # repeats that stay together: two tell the noise


def part_of(log: Log) -> tuple[Log, str]:
    """The log, or blocks of it and a sentence that says which share they are."""
    whole_s = sum(_length_s(run) for run in log.runs)
    count = sum(map(len, log.runs))
    most_s = max(LEAST_s, whole_s * MOST_SAMPLES / max(log.joint_count * count, 1))
    if whole_s <= most_s:
        return log, ""
    blocks = Log(tuple(block for run in log.runs for block in _blocks(run)), log.sources)
    groups = sorted(
        (group[k : k + TWICE] for group in blocks.repeats() for k in range(0, len(group), TWICE)),
        key=lambda group: _load_and_speed(blocks.runs[group[0]]),
    )
    chosen = _spread_blocks(blocks, groups, most_s)
    used_s = sum(_length_s(blocks.runs[k]) for k in chosen)
    sentence = f"the log is {whole_s:.0f} s long: {used_s:.0f} s of it are used, {len(chosen)} blocks over all loads and speeds"
    return Log(tuple(blocks.runs[k] for k in sorted(chosen)), log.sources), sentence


def _spread_blocks(blocks: Log, groups: list[tuple[int, ...]], most_s: float) -> list[int]:
    """As many groups as fit, evenly among those in order; one of repeats at least, where there are any."""
    repeated = [group for group in groups if len(group) > 1][:1]
    for count in range(len(groups), 0, -1):
        places = np.unique(np.linspace(0.0, len(groups) - 1.0, count).round().astype(int))
        picked = dict.fromkeys([*(groups[k] for k in places.tolist()), *repeated])
        chosen = [k for group in picked for k in group]
        if sum(_length_s(blocks.runs[k]) for k in chosen) <= most_s:
            return chosen
    return list(groups[0])


def _blocks(run: LoggedRun) -> list[LoggedRun]:
    """A run in pieces of equal length; one that is short as it is."""
    count = max(1, round(_length_s(run) / BLOCK_s))
    if count == 1:
        return [run]
    edges, found = np.linspace(0, len(run), count + 1).round().astype(int).tolist(), []
    for begin, end in itertools.pairwise(edges):
        first_s, last_s = (float(run.t_s[k] - run.t_s[0]) for k in (begin, end - 1))
        found.append(run.rows(slice(begin, end), f"{run.name} ({first_s:.0f} to {last_s:.0f} s)"))
    return found


def _length_s(run: LoggedRun) -> float:
    return float(run.t_s[-1] - run.t_s[0])


def _load_and_speed(run: LoggedRun) -> tuple[float, float]:
    """Payload [kg] and the mean speed of all joints, from their encoders [rad/s]."""
    return run.payload, float(np.abs(np.diff(run.q_rad, axis=0)).sum()) / max(_length_s(run), 1e-9)
