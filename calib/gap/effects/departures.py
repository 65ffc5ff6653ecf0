"""The ways in which a real part departs from its law: functions of its own variable, by which the law is multiplied."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from calib.arrays import Array
from calib.gap.residuals.scene import Response, RowConditions, SeriesScene
from calib.gap.residuals.term import departed, size_of, stacked

Shape = Callable[[RowConditions, int], Array]  # (c, rows), from what stands beside and the joint


def _unit(values: Array) -> Array:
    """Over the root mean square."""
    size = float(np.sqrt(np.mean(values**2)))
    return values / size if size > 0.0 else values


def by_angle(at: RowConditions, j: int) -> Array:
    """Two harmonics of the joint's turn, and what is slower over its travel."""
    q = at.q[:, j]
    return np.array([np.sin(q), np.cos(q), np.sin(2 * q), np.cos(2 * q)])


def by_speed(at: RowConditions, j: int) -> Array:
    """Its absolute value and its square."""
    v = _unit(at.speed[:, j])
    return np.array([np.abs(v), v**2])


def by_direction(at: RowConditions, j: int) -> Array:
    """One way and the other."""
    return at.direction[:, j][None]


def by_load(at: RowConditions, j: int) -> Array:
    """Of what the gear transmits: its absolute value, its root and its square."""
    load = np.abs(_unit(at.load_Nm[:, j]))
    return np.array([load, np.sqrt(load), load**2])


def by_current(at: RowConditions, j: int) -> Array:
    """Of the motor: its absolute value and its square."""
    i = _unit(at.current_A[:, j])
    return np.array([np.abs(i), i**2])


def by_currents(at: RowConditions, j: int) -> Array:
    """Of all motors together."""
    return _unit(np.sum(np.abs(at.current_A), axis=1))[None]


def departures(
    scene: SeriesScene, shapes: Sequence[Shape], joint: int, law: Response
) -> tuple[dict[int, Array], Array]:
    """Columns of a law's departures on a joint (0-based), each as large as the law; every channel for itself.

    With them what departures change that looks like the law itself, a part of each for every shape of a variable (`departed`), of
    the channel that shows the law best. A motor that saturates gives less torque, and its back-EMF is as before. What currents
    show of a gear is mostly how its angle changes, with the noise of that: where the tip shows the angle, it alone says how the
    gear departs.
    """
    if not shapes or not law:
        return {}, np.zeros((0, 1, 1))
    parts, alike, largest = [], np.zeros((0, 1, 1)), 0.0
    channels = list(dict.fromkeys(scene.cells[cell].channel for cell in law))
    for channel in channels:
        own = {cell: columns for cell, columns in law.items() if scene.cells[cell].channel == channel}
        wanted = {cell: [one(scene.beside[cell], joint) for one in shapes] for cell in own}
        bent, taken = departed(own, {cell: np.concatenate(some) for cell, some in wanted.items()})
        if bent:
            parts.append(bent)
        if (size := float(np.linalg.norm(size_of(own)))) > largest:
            counts = [len(some) for some in next(iter(wanted.values()))]
            alike, largest = taken / np.sqrt(np.repeat(counts, counts))[:, None, None], size
    return (stacked(parts) if parts else {}), alike
