"""Where the console reads and writes."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Files:
    """Named places, way-points taught, the file of lines done, the folder of sessions."""

    places: Path
    taught: Path
    lines: Path | None = None
    sessions: Path = Path("sessions")
