"""The files that a result depends on, by name and hash."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class InputFile:
    """A file that the result depends on."""

    name: str
    sha256: str
    what: str


def input_file(path: Path, what: str) -> InputFile:
    """Name and SHA-256 of a file."""
    with path.open("rb") as file:
        return InputFile(path.name, hashlib.file_digest(file, "sha256").hexdigest(), what)
