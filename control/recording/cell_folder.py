"""The recording of a cell: a folder with one recording an arm, all on one clock and with one count of cycles; as one table.

NAME-DATE-TIME/ARM-DATE-TIME.armlog, and the files in which they continue. Each is complete by itself: its header has the arm, and
where every base of the cell stands.
"""

import csv
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from control.model.cell import Cell, Placed
from control.recording.export import csv_cell, open_text
from control.recording.reading import RecordError, Recording, recorded_arm
from control.recording.recorder_state import SUFFIX

PART = re.compile(rf"(?P<stem>.+?)(\.part(?P<number>\d+))?{re.escape(SUFFIX)}")


def new_folder(log_folder: Path, cell: str, at: str) -> Path:
    """Create the folder of a run of a cell that begins `at` (DATE-TIME)."""
    path, number = log_folder / f"{cell}-{at}", 1
    while path.exists():
        number += 1
        path = log_folder / f"{cell}-{at}-{number}"
    path.mkdir()
    return path


def recordings_in(folder: Path) -> list[Recording]:
    """The recording of each arm, in the order of the cell; the earliest file that is there of each.

    RecordError if the folder has none, or if they are not of different arms of one cell.
    """
    recordings = [Recording.open(path) for path in _earliest(folder)]
    if not recordings:
        raise RecordError(
            f"{folder}: a folder without recordings ({SUFFIX}); `armwright serve --cell` makes one a run, with one file an arm"
        )
    require_one_cell(recordings)
    order = list(_about_cell(recordings[0]).get("bases") or ())
    return sorted(recordings, key=lambda one: order.index(arm_of(one)) if arm_of(one) in order else len(order))


def _earliest(folder: Path) -> list[Path]:
    """The earliest file of each recording: its first ones may have been removed to make room."""
    earliest: dict[str, tuple[int, Path]] = {}
    for path in folder.glob(f"*{SUFFIX}"):
        if named := PART.fullmatch(path.name):
            part = int(named["number"] or 1), path
            earliest[named["stem"]] = min(part, earliest.get(named["stem"], part))
    return [path for _, path in sorted(earliest.values(), key=lambda part: part[1])]


def require_one_cell(recordings: Sequence[Recording]) -> None:
    """RecordError unless they are of different arms that one cell's runtime has recorded."""
    names: list[str] = []
    cells = {str(_about_cell(recording).get("name", "")) for recording in recordings}
    for recording in recordings:
        name = arm_of(recording)
        if not _about_cell(recording):
            raise RecordError(
                f"{recording.path}: expected the recording of an arm of a cell, got that of arm {name!r} alone; give the file"
            )
        if name in names:
            raise RecordError(f"{recording.path}: expected another arm, got {name!r} again")
        names.append(name)
    if len(cells) > 1:
        raise RecordError(f"{recordings[-1].path}: expected arms of one cell, got those of {', '.join(sorted(cells))}")


def arm_of(recording: Recording) -> str:
    """The arm's name."""
    return str(recording.header.get("arm", ""))


def recorded_cell(recordings: Sequence[Recording]) -> Cell:
    """The cell as its headers say. RecordError if an arm is unknown, or no base is given for it."""
    placed = []
    for recording in recordings:
        try:
            arm, base = recorded_arm(recording), _about_cell(recording)["bases"][arm_of(recording)]
            (x, y, z), (qw, qx, qy, qz) = base["origin_m"], base["orientation"]
        except (LookupError, TypeError, ValueError):
            arm = None
        if arm is None:
            raise RecordError(f"{recording.path}: its header does not say what arm {arm_of(recording)!r} is, and where it stands")
        placed.append(Placed(arm, (x, y, z), (qw, qx, qy, qz)))
    return Cell(str(_about_cell(recordings[0])["name"]), tuple(placed))


def _about_cell(recording: Recording) -> dict[str, Any]:
    """What the header says of the cell; nothing of an arm alone."""
    about = recording.header.get("cell")
    return about if isinstance(about, dict) else {}


# Recordings of several arms of one cell as one table: a row a cycle, each arm's columns with its name before them.
#
# All arms of a cell are recorded on one clock, with one count of cycles; rows of one cycle belong together.

SHARED = ("cycle", "t_s")
FILE_NAME = "cell.csv.gz"
SAME_S = 1e-6  # rounding of stored times


def join(recordings: Sequence[Recording], out: Path, every: int = 1, report: Callable[[int], None] = lambda row: None) -> int:
    """Write every k-th cycle that all recordings have; returns the number of rows. RecordError unless they are of one run.

    Modes are numbers, as in the recordings' header; `report` is called every thousand rows.
    """
    names = [arm_of(log) for log in recordings]
    columns = [[k for k, name in enumerate(log.layout.names) if name not in SHARED] for log in recordings]
    titles = [f"{arm}.{log.layout.names[k]}" for arm, log, used in zip(names, recordings, columns, strict=True) for k in used]
    written = 0
    with open_text(out) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*SHARED, *titles])
        for number, (cycle, t_s, rows) in enumerate(_cycles(recordings)):
            if number % 1000 == 0:
                report(number)
            if number % every == 0:
                cells = [row[k] for row, used in zip(rows, columns, strict=True) for k in used]
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
                    row if cycle == newest else next(stream) for row, cycle, stream in zip(rows, cycles, streams, strict=True)
                ]
    except StopIteration:
        return
