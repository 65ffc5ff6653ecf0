"""boards.json: registered poses of the calibration board in each setup."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arrays import Array, frozen
from calib.boards.registration import Registration
from calib.errors import RegistrationError
from calib.points.writer import replace_file
from control.files import parsed_json, read_text

FORMAT = "boards/1"
SD_KEYS = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
ROTATION_TOLERANCE = 1e-6  # of rotation @ rotation.T - 1: the file holds 12 decimals


@dataclass(frozen=True, slots=True)
class BoardPose:
    """A board's frame in the base frame: rotation (3, 3) base_R_board, origin_m (3,)."""

    rotation: Array
    origin_m: Array

    def to_base(self, board_m: Array) -> Array:
        """Points of the board (k, 3) in the base frame."""
        return np.asarray(board_m @ self.rotation.T + self.origin_m)


def write_boards(
    path: Path,
    arm: str,
    found: Mapping[str, Registration],
    inputs: Mapping[str, str],
    date: str,
    program: str,
) -> None:
    """Write the poses with residuals and standard deviations; `inputs` maps files to their SHA-256."""
    content = {
        "format": FORMAT,
        "arm": arm,
        "date": date,
        "program_version": program,
        "inputs": dict(inputs),
        "boards": {setup: _board(one) for setup, one in found.items()},
    }
    replace_file(path, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


def read_boards(path: Path) -> dict[str, BoardPose]:
    """The poses by setup. RegistrationError names file and key."""
    try:
        content = parsed_json(read_text(path))
    except OSError as error:
        raise RegistrationError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise RegistrationError(f"{path}: not JSON ({error})") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        got = content.get("format") if isinstance(content, dict) else content
        raise RegistrationError(f'{path}, format: expected "{FORMAT}", got {got!r}')
    boards = content.get("boards")
    if not isinstance(boards, dict) or not boards:
        raise RegistrationError(f"{path}, boards: expected one entry per setup, got {boards!r}")
    return {setup: _pose(path, setup, entry) for setup, entry in boards.items()}


def _board(found: Registration) -> dict[str, object]:
    return {
        "origin_m": _numbers(found.origin_m),
        "rotation": [_numbers(row) for row in found.rotation],
        "sd": dict(zip(SD_KEYS, _numbers(found.sd), strict=True)),
        "noise_m": round(found.noise_m, 12),
        "residual_m": {
            name: _numbers(residual) for name, residual in zip(found.names, found.residual_m, strict=True)
        },
        "outliers": list(found.outliers),
        "notes": list(found.notes),
    }


def _numbers(values: Array) -> list[float]:
    return [round(float(value), 12) for value in values]


def _pose(path: Path, setup: str, entry: object) -> BoardPose:
    where = f"{path}, boards.{setup}"
    if not isinstance(entry, dict):
        raise RegistrationError(f"{where}: expected origin_m and rotation, got {entry!r}")
    origin = _array(f"{where}.origin_m", entry.get("origin_m"), (3,))
    rotation = _array(f"{where}.rotation", entry.get("rotation"), (3, 3))
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), rtol=0.0, atol=ROTATION_TOLERANCE)
    if not is_rotation or np.linalg.det(rotation) < 0.0:
        raise RegistrationError(f"{where}.rotation: expected the rows of a rotation, got {rotation.tolist()}")
    return BoardPose(rotation, origin)


def _array(where: str, value: object, shape: tuple[int, ...]) -> Array:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        array = np.array(np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        raise RegistrationError(f"{where}: expected {' by '.join(map(str, shape))} numbers, got {value!r}")
    return frozen(array)
