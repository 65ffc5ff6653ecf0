"""What stands beside every result: the files it came from, its date, the program; and its one form for other programs.

In: records of the rooms (dataclasses, msgspec structs, arrays). Out: JSON with keys named like their fields, in SI units; a
number that is not known (NaN, infinite) is null.
"""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

from calib.arrays import Array, frozen
from control.files import parsed_json, read_text, write_whole
from control.model.arm import Arm, Calibration

DECIMALS: Final = 12  # of a metre or a radian, in result files


@dataclass(frozen=True, slots=True)
class InputFile:
    """A file that the result depends on."""

    name: str
    sha256: str
    what: str


def input_file(path: Path, what: str, name: str = "") -> InputFile:
    """Name (of the file, if no other is given) and SHA-256 of a file."""
    with path.open("rb") as file:
        return InputFile(name or path.name, hashlib.file_digest(file, "sha256").hexdigest(), what)


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where a result comes from: the files that it depends on, its date, and the program with its version."""

    inputs: tuple[InputFile, ...]
    date: str
    program: str

    @property
    def hashes(self) -> dict[str, str]:
        """SHA-256 of the files by name."""
        return {file.name: file.sha256 for file in self.inputs}

    @property
    def line(self) -> str:
        """Date and program, for a page's heading."""
        return f"{self.date} · {self.program}"

    def heading(self, form: str, **more: str) -> dict[str, object]:
        """The first entries of a result file of the format `form`, such as "trust/1"."""
        return {"format": form, **more, "date": self.date, "program_version": self.program, "inputs": self.hashes}

    def of_arm(self, nominal: Arm, objective: str) -> Calibration:
        """For the file of an arm that was made of `nominal`."""
        source = nominal.path.name if nominal.path is not None else nominal.name
        return Calibration(source, self.hashes, self.date, objective, self.program)


def made_today(*inputs: InputFile) -> Provenance:
    """Of a result that this program makes now; the date is UTC's."""
    return Provenance(inputs, datetime.datetime.now(datetime.UTC).date().isoformat(), f"armwright {version('armwright')}")


def json_text(content: object) -> str:
    """Records as indented JSON; what is not a finite number is null, an array a list."""
    return msgspec.json.format(msgspec.json.encode(content, enc_hook=_plain), indent=2).decode() + "\n"


def entries(record: object, *names: str) -> dict[str, object]:
    """Fields and properties of a record under their own names."""
    return {name: getattr(record, name) for name in names}


def write_json(path: Path, content: object) -> None:
    """Write a result file, whole or not at all. NotWritten."""
    write_whole(path, json_text(content))


def read_json(path: Path, form: str, fault: Callable[[str], Exception]) -> dict[str, Any]:
    """The content of a result file of the format `form`, such as "boards/1"; raises `fault(what is wrong)`."""
    try:
        content = parsed_json(read_text(path))
    except OSError as error:
        raise fault(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise fault(f"{path}: not JSON ({error})") from error
    got = content.get("format") if isinstance(content, dict) else content
    if got != form or not isinstance(content, dict):
        raise fault(f'{path}, format: expected "{form}", got {got!r}')
    return content


def array_in(where: str, value: object, shape: tuple[int, ...], fault: Callable[[str], Exception]) -> Array:
    """Finite numbers of this shape in a result file; raises `fault(what is wrong where)`."""
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        raise fault(f"{where}: expected {' by '.join(map(str, shape))} numbers, got {value!r}")
    return frozen(array)


def _plain(value: Any) -> object:
    """Of what msgspec does not know: numpy's arrays and numbers."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no form in a result file")
