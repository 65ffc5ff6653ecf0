"""State of the recording: running or stopped, since when and why, its size and how long the disk lasts.

A large recording continues in further files: NAME.armlog, NAME.part2.armlog, NAME.part3.armlog, ...
"""

import os
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class RecorderState:
    """The answer of `status` under `recorder`. `reason` says why rows are not recorded; empty while they are."""

    is_on: bool
    file: str = ""
    reason: str = ""
    since_unix_s: float = 0.0
    lost_rows: int = 0
    written_bytes: int = 0
    bytes_per_h: float = 0.0
    hours_left: float | None = None

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> "RecorderState":
        """Decode a message; keys that are unknown to this version are ignored."""
        known = {field.name for field in fields(cls)}
        return cls(**{key: value for key, value in content.items() if key in known})

    def content(self) -> dict[str, Any]:
        """As a JSON object."""
        return asdict(self)

    def plus_lost(self, rows: int) -> "RecorderState":
        """The state with additional lost rows."""
        return replace(self, lost_rows=self.lost_rows + rows)

    def usage(self) -> str:
        """Data rate and remaining time as text: `60 MB/h, room for 200 h`."""
        rate = f"{1e-6 * self.bytes_per_h:.0f} MB/h"
        if self.hours_left is None:
            return rate
        return f"{rate}, room for {self.time_left()}"

    def time_left(self) -> str:
        """How long the disk lasts, in words; empty where that is not known."""
        if self.hours_left is None:
            return ""
        if self.hours_left >= 2.0:
            return f"{self.hours_left:.0f} h"
        minutes = 60.0 * self.hours_left
        return f"{minutes:.0f} min" if minutes >= 1.0 else "less than 1 min"


def hours_left(folder: Path, bytes_per_h: float) -> float | None:
    """How long the disk of `folder` lasts at this rate; None if unknown."""
    try:
        disk = os.statvfs(folder)
    except OSError:
        return None
    return disk.f_bavail * disk.f_frsize / bytes_per_h if bytes_per_h > 0.0 else None


SUFFIX = ".armlog"


def next_part(path: Path) -> Path:
    """The file in which the recording `path` continues: NAME.armlog, NAME.part2.armlog, NAME.part3.armlog, ..."""
    stem = path.name.removesuffix(SUFFIX)
    if found := re.fullmatch(r"(.+)\.part(\d+)", stem):
        return path.with_name(f"{found[1]}.part{int(found[2]) + 1}{SUFFIX}")
    return path.with_name(f"{stem}.part2{SUFFIX}")


def parts_from(path: Path) -> list[Path]:
    """A recording and its continuation files, in order."""
    parts = [path]
    while has_part(following := next_part(parts[-1])):
        parts.append(following)
    return parts


def last_part(path: Path) -> Path:
    """The latest file of a recording, of which earlier ones may have been removed."""
    part = re.compile(re.escape(path.name.removesuffix(SUFFIX)) + r"\.part(\d+)" + re.escape(SUFFIX))
    found = [(int(named[1]), other) for other in path.parent.iterdir() if (named := part.fullmatch(other.name))]
    return max(found, default=(1, path))[1]


def has_part(path: Path) -> bool:
    """Whether the file exists and has a header; a part that is being created is empty."""
    return path.exists() and path.stat().st_size > 0
