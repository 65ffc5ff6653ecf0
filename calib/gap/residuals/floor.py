"""The noise floor of each cell: from repeats, but not below what an encoder's step leaves; else from the data sheet."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

from calib.arrays import Array
from calib.gap.signals.body import Load
from calib.gap.signals.physics import Physics

Places = npt.NDArray[np.intp]
Block = tuple[str, int, Array, int, Places]
Key = tuple[str, int]
NORMAL = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
FEWEST = 50  # rows of a pair of repeats that make a floor


def floors(physics: Physics, blocks: list[Block]) -> tuple[dict[Key, float], str]:
    """SI floors by cell and where they come from."""
    keys = list(dict.fromkeys((channel, joint) for channel, joint, *_ in blocks))
    result: dict[Key, float] = {}
    source = "repeats"
    for key in keys:
        by_run = {k: (places, values) for *name, values, k, places in blocks if tuple(name) == key}
        repeated = _from_repeats(physics, by_run, 3 if key[0] == "tip_m" else 1)
        if repeated is None:
            source = "data sheet, encoder steps and the currents' own noise"
        noise, step = _from_noise(physics, key)
        # Repeats of the same motion meet the same encoder steps: their difference cannot show that part.
        result[key] = float(np.hypot(noise if repeated is None else repeated, step))
    return result, source


def _from_repeats(physics: Physics, by_run: dict[int, tuple[Places, Array]], axes: int) -> float | None:
    """Repeats differ by noise alone: their residuals' difference over sqrt 2; the middle of all pairs."""
    differences = []
    for group in physics.recording.repeats:
        for a, b in itertools.pairwise(group):
            differences.append(_difference(*by_run[a], *by_run[b], axes))
    found = [d for d in differences if len(d) >= FEWEST and d.any()]  # what never differs repeats nothing
    if not found:
        return None
    pooled = np.concatenate(found)
    robust = NORMAL * float(np.median(np.abs(pooled - np.median(pooled))))
    plain = float(np.sqrt(np.mean(pooled**2)))
    # Where a few rows differ by far more (a stick-slip that falls differently) the middle is the noise.
    return float((robust if plain > 1.3 * robust else plain) / np.sqrt(2.0))


def _difference(places_a: Places, a: Array, places_b: Places, b: Array, axes: int) -> Array:
    _, in_a, in_b = np.intersect1d(places_a[::axes], places_b[::axes], return_indices=True)
    if not len(in_a):
        return np.zeros(0)
    return np.asarray((a.reshape(-1, axes)[in_a] - b.reshape(-1, axes)[in_b]).ravel())


def _from_noise(physics: Physics, key: Key) -> tuple[float, float]:
    """What the sensor's noise leaves in a row, and what the steps of the encoder leave."""
    channel, joint = key
    if channel == "tip_m":
        camera = physics.arm.camera
        return (camera.position_noise_m if camera and camera.position_noise_m > 0 else 0.0005), 0.0
    recording = physics.recording
    K, R = float(physics.torque_per_A[joint]), physics.arm.drives[joint].resistance_ohm
    drive = physics.arm.drives[joint]
    step = 2.0 * np.pi / (drive.encoder_counts_per_rev * drive.gear_ratio)
    angle = max(step, _seen_step(physics, joint, step)) / np.sqrt(12.0)
    bent = np.convolve(recording.filters.state[2], recording.filters.row)
    turning = np.convolve(recording.filters.state[1], recording.filters.row)
    own = np.concatenate(physics.body.own_inertia(Load(), joint))
    inertia = float(physics.body.rotor_kg_m2[joint] + np.median(own))
    bends = float(np.linalg.norm(bent)) * inertia / K
    turns = float(np.linalg.norm(turning)) * K / R
    by_channel = bends if channel == "current_A" else turns
    if (
        channel == "current_A" and not recording.has_current
    ):  # the current is then the voltage's, less the speed's
        by_channel = float(np.hypot(bends, turns))
    return _current_noise(physics, joint) * recording.filters.row_gain, angle * by_channel


def _seen_step(physics: Physics, joint: int, step: float) -> float:
    """The step of the recorded angles, which may be coarser than the encoder's: the smallest between neighbours."""
    found = [np.diff(np.unique(run.q_raw[:, joint])) for run in physics.recording.runs]
    counted = np.concatenate([part[part > 0.5 * step] for part in found])  # less is the printing's
    return float(counted.min()) if len(counted) else 0.0


def _current_noise(physics: Physics, joint: int) -> float:
    """White noise of the current sensor, the middle of all runs."""
    if not physics.recording.has_current:
        return 0.0
    rough = [physics.current_roughness(k, joint) for k in range(len(physics.recording.runs))]
    return float(np.median(rough))
