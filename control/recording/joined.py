"""Recordings of several arms of one cell as one table: a row a cycle, each arm's columns with its name before them.

All arms of a cell are recorded on one clock, with one count of cycles; rows of one cycle belong together.
"""

import csv
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from control.recording.cell_folder import arm_of
from control.recording.export import csv_cell, open_text
from control.recording.reading import RecordError, Recording

SHARED = ("cycle", "t_s")
FILE_NAME = "cell.csv.gz"
SAME_S = 1e-6  # rounding of stored times


def join(
    recordings: Sequence[Recording],
    out: Path,
    every: int = 1,
    report: Callable[[int], None] = lambda row: None,
) -> int:
    """Write every k-th cycle that all recordings have; returns the number of rows. RecordError unless they are of one run.

    Modes are numbers, as in the recordings' header; `report` is called every thousand rows.
    """
    names = [arm_of(one) for one in recordings]
    columns = [[k for k, name in enumerate(one.layout.names) if name not in SHARED] for one in recordings]
    titles = [
        f"{arm}.{one.layout.names[k]}"
        for arm, one, kept in zip(names, recordings, columns, strict=True)
        for k in kept
    ]
    written = 0
    with open_text(out) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*SHARED, *titles])
        for number, (cycle, t_s, rows) in enumerate(_cycles(recordings)):
            if number % 1000 == 0:
                report(number)
            if number % every == 0:
                cells = [row[k] for row, kept in zip(rows, columns, strict=True) for k in kept]
                writer.writerow([cycle, *map(csv_cell, (t_s, *cells))])
                written += 1
    return written


def _cycles(recordings: Sequence[Recording]) -> Iterator[tuple[int, float, list[tuple[float, ...]]]]:
    """Cycle, time and the row of each arm, where all have one. RecordError if one cycle has two times."""
    at = [[one.layout.names.index(name) for name in SHARED] for one in recordings]
    streams = [one.rows() for one in recordings]
    try:
        rows = [next(stream) for stream in streams]
        while True:
            cycles = [row[cycle] for row, (cycle, _) in zip(rows, at, strict=True)]
            newest = max(cycles)
            if min(cycles) == newest:
                times = [row[t] for row, (_, t) in zip(rows, at, strict=True)]
                if max(times) - min(times) > SAME_S:
                    raise RecordError(
                        f"{recordings[-1].path}: cycle {int(newest)} was at {times[-1]:.3f} s, and that of"
                        f" {recordings[0].path} at {times[0]:.3f} s: they are not of one run of `armwright serve`"
                    )
                yield int(newest), times[0], rows
                rows = [next(stream) for stream in streams]
            else:  # lost by one of the recordings
                rows = [
                    row if cycle == newest else next(stream)
                    for row, cycle, stream in zip(rows, cycles, streams, strict=True)
                ]
    except StopIteration:
        return
