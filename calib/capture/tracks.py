"""What a recording holds: bodies and markers over the frames of the system's own clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calib.arrays import Array
from calib.errors import CalibrationError
from control.kinematics.rotation import matrices
from control.model.camera import CameraStream

Mask = npt.NDArray[np.bool_]
IN_LINE = 0.1  # sine of the angle between two edges
FRAMES_MOST = 2_000_000  # 2.7 hours at 200 Hz


class CaptureError(CalibrationError):
    """A recording is not of its format, or cannot be brought to the arm's time; the message says what to do."""


@dataclass(frozen=True, slots=True)
class BodyTrack:
    """Position (m, 3) [m] and rotation (m, 3, 3) of a body in the system's frame, NaN where it was not seen.

    rotation None: a single marker, which has none.
    """

    position_m: Array
    rotation: Array | None = None

    @property
    def is_seen(self) -> Mask:
        """(m,), whether it was seen."""
        return np.asarray(np.isfinite(self.position_m).all(axis=1))


@dataclass(frozen=True, slots=True)
class Capture:
    """A recording of frames at t_s (m,), of the system's own clock from its first frame; `notes`: what was odd about the file."""

    path: Path
    t_s: Array
    bodies: Mapping[str, BodyTrack]
    markers: Mapping[str, Array]
    notes: tuple[str, ...] = ()

    def body(self, name: str) -> BodyTrack:
        """A body by its name, or one of markers: `A` alone, or `A+B+C` of three or more. CaptureError lists the names."""
        if name in self.bodies:
            return self.bodies[name]
        parts = [part.strip() for part in name.split("+")]
        if all(part in self.markers for part in parts) and len(parts) != 2:
            places = np.stack([self.markers[part] for part in parts])
            return BodyTrack(places[0]) if len(parts) == 1 else fitted_body(name, places)
        there = ", ".join([*self.bodies, *self.markers]) or "none"
        raise CaptureError(
            f'{self.path}: no body "{name}": expected one of {there}, or three or more markers joined by "+"'
        )


def fitted_body(name: str, places_m: Array) -> BodyTrack:
    """The body of markers (k, m, 3), the same in every recording: origin at their centre, x from the first towards the second
    marker, z normal to the first three.

    Its shape is the mean of all frames that show every marker; a frame with fewer than three of them does not show it.
    CaptureError if the first three are in line, or all are never seen together.
    """
    seen = np.asarray(np.isfinite(places_m).all(axis=2))
    whole = np.flatnonzero(seen.all(axis=0))
    if not len(whole):
        raise CaptureError(f'body "{name}": no frame shows all of its markers')
    shape = _shape(name, places_m[:, whole])
    position = np.full((places_m.shape[1], 3), np.nan)
    rotation = np.full((places_m.shape[1], 3, 3), np.nan)
    for count in range(3, len(shape) + 1):
        for mask in {tuple(row) for row in seen[:, seen.sum(axis=0) == count].T.tolist()}:
            rows = np.flatnonzero((seen == np.array(mask)[:, None]).all(axis=0))
            here = np.flatnonzero(mask)
            rotation[rows], position[rows] = _motions(shape[here], places_m[np.ix_(here, rows)])
    return BodyTrack(position, rotation)


def _shape(name: str, places_m: Array) -> Array:
    """Markers (k, 3) in the body's frame, from frames (k, m, 3) that show all."""
    first = places_m[:, 0] - places_m[:, 0].mean(axis=0)
    turns, origins = _motions(first, places_m)
    mean = np.einsum("rji,krj->kri", turns, places_m - origins).mean(axis=1)
    mean -= mean.mean(axis=0)
    x, other = mean[1] - mean[0], mean[2] - mean[0]
    z = np.cross(x, other)
    if np.linalg.norm(z) < IN_LINE * np.linalg.norm(x) * np.linalg.norm(other):
        raise CaptureError(
            f'body "{name}": its first three markers lie on one line: no orientation follows from them'
        )
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    return np.asarray(mean @ np.column_stack((x, np.cross(z, x), z)))


def _motions(shape: Array, places: Array) -> tuple[Array, Array]:
    """Rotations (r, 3, 3) and origins (r, 3) that take a shape (k, 3) to places (k, r, 3): Kabsch."""
    middle, centre = shape.mean(axis=0), places.mean(axis=0)
    covariance = np.einsum("ki,krj->rij", shape - middle, places - centre)
    left, _, right = np.linalg.svd(covariance)
    sign = np.linalg.det(left @ right)
    right[:, 2] *= sign[:, None]
    rotation = np.swapaxes(left @ right, 1, 2)
    return rotation, centre - rotation @ middle


def placed_m(stream: CameraStream, seen_m: Array) -> Array:
    """Places (..., 3) in the frame of a stream that a calibration has placed, in the arm's base frame."""
    if stream.origin_m is None:
        raise CaptureError("[camera.stream] has no origin_m: calibrate first")
    (turn,) = matrices(np.array([stream.orientation]))
    return np.asarray(seen_m @ turn.T + np.array(stream.origin_m))


def relative(body: BodyTrack, base: BodyTrack) -> BodyTrack:
    """The body in the frame of another one: both seen; the base's pose is that of all frames, since it stands still."""
    if base.rotation is None:
        raise CaptureError("a base body needs an orientation: three or more markers")
    rows = base.is_seen & np.asarray(np.isfinite(base.rotation).all(axis=(1, 2)))
    if not rows.any():
        raise CaptureError("the base body is in no frame")
    origin = np.median(base.position_m[rows], axis=0)
    far = np.linalg.norm(base.position_m[rows] - origin, axis=1)
    if float(np.quantile(far, 0.95)) > 5e-3:
        raise CaptureError(
            f"the base body moves by {1e3 * float(np.quantile(far, 0.95)):.0f} mm: expected one that stands with the arm"
        )
    left, _, right = np.linalg.svd(base.rotation[rows].mean(axis=0))
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    origin = base.position_m[rows].mean(axis=0)
    return BodyTrack(
        (body.position_m - origin) @ turn, None if body.rotation is None else turn.T @ body.rotation
    )
