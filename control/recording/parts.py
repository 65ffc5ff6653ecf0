"""The files in which a large recording continues: NAME.armlog, NAME.part2.armlog, NAME.part3.armlog, ..."""

import re
from pathlib import Path

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
    found = [
        (int(named[1]), other) for other in path.parent.iterdir() if (named := part.fullmatch(other.name))
    ]
    return max(found, default=(1, path))[1]


def has_part(path: Path) -> bool:
    """Whether the file exists and has a header; a part that is being created is empty."""
    return path.exists() and path.stat().st_size > 0
