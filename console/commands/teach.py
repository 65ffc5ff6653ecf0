"""`armwright teach FILE`: add where the tip is to a way-point file, as `armwright run` takes it."""

import argparse
import sys
from pathlib import Path

from console.commands.connection import connected
from control.errors import ArmError
from control.files import write_whole
from control.motion.waypoints import POSITION_COLUMNS

HEADER = ",".join(POSITION_COLUMNS)
SAME_m = 1e-4  # two way-points nearer than this are one: no path can turn there


def run(given: argparse.Namespace) -> int:
    """Append one way-point; the file is begun where there is none."""
    status = connected(given).status()
    if status["tip_m"] is None:
        raise ArmError("teach: the tip's position is not known yet: `armwright home`")
    file = Path(given.file)
    lines = _lines(file)
    point = tuple(round(float(x), 6) for x in status["tip_m"])
    if len(lines) > 1 and _distance_m(lines[-1], point) < SAME_m:
        raise ArmError(f"teach: the tip has not moved since the last way-point of {file}")
    row = ",".join(f"{x:.6f}" for x in point)
    write_whole(file, "\n".join([*lines, row]) + "\n")
    sys.stdout.write(f"way-point {len(lines)} in {file}: {row}\n")
    return 0


def _lines(file: Path) -> list[str]:
    if not file.exists():
        return [HEADER]
    try:
        lines = [line for line in file.read_text(encoding="utf-8").splitlines() if line.strip()]
    except UnicodeDecodeError as error:
        raise ArmError(f"teach: {file}: not UTF-8 text (byte {error.start}): give another file") from None
    if lines and lines[0].strip() != HEADER:
        raise ArmError(
            f"teach: {file}: expected the header {HEADER}, got {lines[0][:80]!r}: give another file"
        )
    return lines or [HEADER]


def _distance_m(line: str, point: tuple[float, ...]) -> float:
    import math

    try:
        return math.dist([float(x) for x in line.split(",")], point)
    except ValueError:
        return math.inf
