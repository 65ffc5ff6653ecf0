"""A part of a long log that says what the whole does: blocks of its runs, spread over loads and speeds, repeats together."""

from __future__ import annotations

import itertools

import numpy as np

from calib.gap.log import Log, LoggedRun

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
        key=lambda group: (blocks.runs[group[0]].payload, _speed_rad_s(blocks.runs[group[0]])),
    )
    chosen = _spread(blocks, groups, most_s)
    used_s = sum(_length_s(blocks.runs[k]) for k in chosen)
    sentence = f"the log is {whole_s:.0f} s long: {used_s:.0f} s of it are used, {len(chosen)} blocks over all loads and speeds"
    return Log(tuple(blocks.runs[k] for k in sorted(chosen)), log.sources), sentence


def _spread(blocks: Log, groups: list[tuple[int, ...]], most_s: float) -> list[int]:
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
    edges = np.linspace(0, len(run), count + 1).round().astype(int).tolist()
    return [_piece(run, slice(a, b)) for a, b in itertools.pairwise(edges)]


def _piece(run: LoggedRun, rows: slice) -> LoggedRun:
    begin, end = (float(t) - float(run.t_s[0]) for t in (run.t_s[rows][0], run.t_s[rows][-1]))
    return run.rows(rows, f"{run.name} ({begin:.0f} to {end:.0f} s)")


def _length_s(run: LoggedRun) -> float:
    return float(run.t_s[-1] - run.t_s[0])


def _speed_rad_s(run: LoggedRun) -> float:
    """Mean speed of all joints over a block, from its encoders."""
    return float(np.abs(np.diff(run.q_rad, axis=0)).sum()) / max(_length_s(run), 1e-9)
