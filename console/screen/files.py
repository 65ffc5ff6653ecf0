"""Paths of the console's files."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Files:
    """Named places, taught way-points, the record of executed lines, the folder of sessions."""

    places: Path
    taught: Path
    lines: Path | None = None
    sessions: Path = Path("sessions")
