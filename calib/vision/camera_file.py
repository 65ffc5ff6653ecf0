"""camera.json: the lens of a camera with its covariance, written by `armwright camera calibrate`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.arrays import frozen
from calib.errors import VisionError
from calib.results import Provenance, entries, write_json
from calib.vision.intrinsics import LensFit
from calib.vision.lens import NAMES, Lens
from control.files import parsed_json, read_text

FORMAT = "camera/1"
PIXELS_MOST = 100_000
READOUT_MOST_s = 1.0


def write_camera(
    path: Path,
    fit: LensFit,
    target: str,
    said: Sequence[str],
    made: Provenance,
) -> None:
    """Write the fit; `said`: the advice."""
    lens = fit.lens
    content = {
        "target": target,
        **entries(lens, "width_px", "height_px", "readout_s", "covariance", "noise_px"),
        "lens": dict(zip(NAMES, lens.values, strict=True)),
        "sd": dict(zip(NAMES, lens.sd, strict=True)),
        **entries(fit, "rms_px", "held_out_px"),
        "pictures": [
            {
                "name": one.sighting.name,
                "corners": len(one.sighting.corners),
                **entries(one, "rms_px", "distance_m"),
                "tilt_rad": one.tilt,
                "blur_px": one.sighting.blur_px,
            }
            for one in fit.seen
        ],
        "without_board": fit.unseen,
        "advice": said,
    }
    write_json(path, made.heading(FORMAT) | content)


def read_camera(path: Path) -> Lens:
    """The lens of a file. VisionError names file and key."""
    try:
        content = parsed_json(read_text(path))
    except OSError as error:
        raise VisionError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise VisionError(f"{path}: not JSON ({error})") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise VisionError(f'{path}, format: expected "{FORMAT}", as `armwright camera calibrate` writes it')
    values = content.get("lens")
    if not isinstance(values, dict):
        raise VisionError(f"{path}, lens: expected {', '.join(NAMES)}, got {values!r}")
    numbers = np.array([_number(path, f"lens.{name}", values.get(name)) for name in NAMES])
    for name, value in zip(NAMES[:2], numbers[:2], strict=True):
        if value <= 0.0:
            raise VisionError(f"{path}, lens.{name}: expected a focal length above 0 px, got {value}")
    return Lens(
        frozen(numbers),
        int(_number(path, "width_px", content.get("width_px"), 1, PIXELS_MOST)),
        int(_number(path, "height_px", content.get("height_px"), 1, PIXELS_MOST)),
        frozen(_covariance(path, content.get("covariance"))),
        _number(path, "noise_px", content.get("noise_px"), 0.0),
        _number(path, "readout_s", content.get("readout_s", 0.0), 0.0, READOUT_MOST_s),
    )


def _number(path: Path, key: str, value: Any, least: float = -np.inf, most: float = np.inf) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not np.isfinite(value) or not least <= value <= most:
        raise VisionError(f"{path}, {key}: expected a number{_limits(least, most)}, got {value!r}")
    return float(value)


def _limits(least: float, most: float) -> str:
    if np.isfinite(most):
        return f" from {least:g} to {most:g}"
    return f" from {least:g} on" if np.isfinite(least) else ""


def _covariance(path: Path, value: Any) -> Any:
    k = len(NAMES)
    try:
        found = np.array(value, dtype=float)
    except (TypeError, ValueError):
        found = np.array(np.nan)
    if found.shape != (k, k) or not np.isfinite(found).all() or not np.allclose(found, found.T):
        raise VisionError(f"{path}, covariance: expected {k} by {k} numbers, symmetric")
    return found
