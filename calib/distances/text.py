"""The result of a calibration with lengths: text for a terminal, entries of calibration.json."""

from __future__ import annotations

import numpy as np

from calib.arrays import Array
from calib.calibration.text import estimate_lines
from calib.distances.calibrate import DistancesFound
from calib.distances.readings import BETWEEN, GAUGE
from calib.identify.estimates import Estimate


def distances_text(made: DistancesFound) -> str:
    """Readings left out first, then what is determined, then the arm and where the devices stand."""
    tips = f", {made.tips} measured tips" if made.tips else ""
    lines = [
        _about_held(made),
        f"{len(made.readings)} readings{tips}: mean error of a length {_mm(made.before_m)} mm with the nominal arm,"
        f" {_mm(made.after_m)} mm after, at the readings of the fit.",
        *_by_device(made),
        "",
        *made.found.in_words(),
        "",
        *estimate_lines(_of_the_arm(made)),
        "",
        *_places(made),
    ]
    return "\n".join(lines) + "\n"


def _about_held(made: DistancesFound) -> str:
    if not len(made.held_m):
        return "Too few readings to leave some out: how good the result is elsewhere is unknown."
    return (
        f"On readings not used (every 5th left out in turn), the mean error went from {_mm(made.before_m)} to"
        f" {_mm(made.held_m)} mm (largest {1e3 * float(np.abs(made.held_m).max()):.3f})."
    )


def _by_device(made: DistancesFound) -> list[str]:
    """A line a device if there are several; distances between two poses are one."""
    kinds = [name.partition(":")[0] if name.startswith(BETWEEN) else name for name in made.readings.device]
    groups = {name: np.flatnonzero(np.array(kinds) == name) for name in dict.fromkeys(kinds)}
    if len(groups) < 2:
        return []
    return [f"{name}: {len(rows)} readings, {_mm(made.after_m[rows])} mm." for name, rows in groups.items()]


def _of_the_arm(made: DistancesFound) -> list[Estimate]:
    of_devices = {parameter.name for device in made.devices for parameter in device.parameters}
    frames = {name for frame in made.found.solution.frames if frame.is_free for name in frame.parameter_names}
    return [one for one in made.found.estimates if one.parameter.name not in of_devices | frames]


def _places(made: DistancesFound) -> list[str]:
    lines = []
    for device, place, zero_m in zip(made.devices, made.places, made.zero_m, strict=True):
        if device.kind == BETWEEN:
            continue
        is_gauge = device.kind == GAUGE
        what = "direction" if is_gauge else "fixed point [m]"
        numbers = ", ".join(f"{value:.5f}" for value in place)
        zero = f", zero {zero_m:.5f} m" if zero_m else ""
        lines.append(f"{device.name}: {what} in the base frame: [{numbers}]{zero}")
    return lines


def distances_json(made: DistancesFound) -> dict[str, object]:
    """Entries of calibration.json besides the identification."""
    return {
        "readings": len(made.readings),
        "held_out": None
        if not len(made.held_m)
        else {
            "mean_before_m": float(np.abs(made.before_m).mean()),
            "mean_after_m": float(np.abs(made.held_m).mean()),
            "max_after_m": float(np.abs(made.held_m).max()),
        },
        "devices": {
            device.name: {
                "direction" if device.kind == GAUGE else "point_m": place.tolist(),
                "zero_m": zero_m,
            }
            for device, place, zero_m in zip(made.devices, made.places, made.zero_m, strict=True)
            if device.kind != BETWEEN
        },
    }


def _mm(errors_m: Array) -> str:
    return f"{1e3 * float(np.abs(errors_m).mean()):.3f}"
