"""Which runs decide and which only report; repeats stay together, and no sample of a run goes elsewhere."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.gap.residuals.rows import RowTable
from calib.gap.signals.recording import EvenRun, RunSet

Picked = npt.NDArray[np.bool_]
MANY = 12  # groups of one load: more than one of them reports
ONE_WAY = 0.7  # of a joint's travel: a run that ends so far from its begin went one way
REPORT_SHARE = 0.34  # of the groups at most


@dataclass(frozen=True, slots=True)
class RowSplit:
    """Rows that decide, in groups that are held out in turn; rows that report; the runs' names of the latter."""

    groups: tuple[Picked, ...]
    deciding: Picked
    reporting: Picked
    report_runs: tuple[str, ...]

    def only(self, rows: Picked) -> RowSplit:
        """The same without other rows."""
        groups = tuple(group & rows for group in self.groups)
        return RowSplit(groups, self.deciding & rows, self.reporting & rows, self.report_runs)


def split(recording: RunSet, table: RowTable) -> RowSplit:
    """Report on a group of repeats of middling speed and on one run of each load and way that others have too.

    So each load and each way of runs that go one way are among what decides, and among what reports.
    """
    if len(recording.runs) == 1:
        return _by_time(recording, table)
    report = _report_groups(recording, {int(k) for k in np.unique(table.run)})
    groups = [g for k, g in enumerate(recording.repeats) if k not in report]
    reporting = np.isin(table.run, [r for k in report for r in recording.repeats[k]])
    names = tuple(recording.runs[r].name for k in report for r in recording.repeats[k])
    picked = tuple(np.asarray(np.isin(table.run, group)) for group in groups)
    return RowSplit(picked, ~reporting, reporting, names)


def _report_groups(recording: RunSet, with_rows: set[int]) -> list[int]:
    """Places in `recording.repeats`, of groups whose runs have rows that count."""
    speeds = [float(np.mean([np.sqrt(np.mean(recording.runs[r].speed ** 2)) for r in group])) for group in recording.repeats]
    kinds = [_kind(recording.runs[group[0]]) for group in recording.repeats]
    most = max(1, int(REPORT_SHARE * len(speeds)))
    chosen: list[int] = []
    for kind in sorted(set(kinds), key=lambda kind: (-kinds.count(kind), kind)):
        groups = [k for k, value in enumerate(kinds) if value == kind and with_rows & {*recording.repeats[k]}]
        if len(groups) < 2 or len(chosen) >= most:
            continue
        groups.sort(key=lambda k: (speeds[k], recording.runs[recording.repeats[k][0]].name))
        if len(groups) >= MANY:  # every fourth, from slow to fast
            chosen += groups[1::4]
            continue
        middle = groups[len(groups) // 2]
        repeated = [k for k in groups[1:-1] if len(recording.repeats[k]) > 1]
        near = min(repeated, key=lambda k: abs(speeds[k] - speeds[middle])) if repeated else middle
        chosen.append(near)
    return chosen or [k for k in range(len(speeds)) if with_rows & {*recording.repeats[k]}][-1:]


def _kind(run: EvenRun) -> tuple[float, ...]:
    """Load, and the way of each joint that ends far from where it began, -1 or 1; 0 where it comes back."""
    gone, travel = run.q[-1] - run.q[0], np.ptp(run.q, axis=0)
    way = np.sign(gone) * (np.abs(gone) > ONE_WAY * np.maximum(travel, 1e-9))
    return round(float(np.median(run.payload_kg)), 4), *(way + 0.0).tolist()


def _by_time(recording: RunSet, table: RowTable) -> RowSplit:
    """One run: its last third reports, the rest decides in four pieces."""
    run = recording.runs[0]
    share = table.t_s / max(run.t_s[-1] - run.t_s[0], 1e-9)
    reporting = np.asarray(share >= 2.0 / 3.0)
    edges = np.linspace(0.0, 2.0 / 3.0, 5)
    pieces = tuple(np.asarray((share >= a) & (share < b)) for a, b in itertools.pairwise(edges))
    return RowSplit(pieces, ~reporting, reporting, (run.name,))
