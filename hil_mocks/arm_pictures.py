"""What a webcam beside the mock arm sees: a printed target on the last link, at the arm's true pose, and how
a camera draws it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hil_mocks.plant.parts import DH_KEYS, Convention, DhLink, rotation_z, true_frame

Array = NDArray[np.float64]


class JointLink(DhLink, Protocol):
    """A link of arm.toml."""

    @property
    def joint(self) -> str: ...


@dataclass(frozen=True, slots=True)
class FramePose:
    """A frame in another: rotation (3, 3), position_m (3,)."""

    rotation: Array
    position_m: Array

    def then(self, inner: FramePose) -> FramePose:
        """A frame given in this one, in this one's own parent."""
        return FramePose(self.rotation @ inner.rotation, self.rotation @ inner.position_m + self.position_m)

    @property
    def inverse(self) -> FramePose:
        """The parent in this frame."""
        return FramePose(self.rotation.T, -self.rotation.T @ self.position_m)


@dataclass(frozen=True, slots=True)
class PicturedArm:
    """An arm whose links are off nominal by `deviations` (link1_d_m ...), a target on its last link, a camera beside it.

    grey: the print; width_m: of the print with its margin; last_T_target, base_T_camera.
    """

    links: Sequence[JointLink]
    convention: Convention
    grey: Grey
    width_m: float
    last_T_target: FramePose
    base_T_camera: FramePose
    webcam: Webcam
    deviations: Mapping[str, float] = field(default_factory=dict)

    def target(self, q_rad: Sequence[float]) -> FramePose:
        """The target in the camera's frame at true joint angles."""
        return self.base_T_camera.inverse.then(self.last_link(q_rad)).then(self.last_T_target)

    def last_link(self, q_rad: Sequence[float]) -> FramePose:
        """The last link's frame in the base frame."""
        place, angles = FramePose(np.eye(3), np.zeros(3)), iter(q_rad)
        for number, link in enumerate(self.links, 1):
            off = {key: self.deviations.get(f"link{number}_{key}", 0.0) for key in DH_KEYS}
            frame = true_frame(link, off, self.convention)
            link_frame = FramePose(frame.rotation, frame.position_m)
            if link.joint == "fixed":
                place = place.then(link_frame)
                continue
            turn = FramePose(rotation_z(next(angles)), np.zeros(3))
            place = place.then(turn).then(link_frame) if self.convention == "standard" else place.then(link_frame).then(turn)
        return place

    def picture(self, q_rad: Sequence[float], draw: np.random.Generator) -> Grey:
        """The webcam's picture."""
        place = self.target(q_rad)
        return self.webcam.picture([PrintedSheet(self.grey, self.width_m, place.rotation, place.position_m)], draw)


def looking_at(place_m: Array, at_m: Array) -> FramePose:
    """base_T_camera of a camera that looks from one place to another, upright."""
    ahead = (at_m - place_m) / np.linalg.norm(at_m - place_m)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return FramePose(np.column_stack((right, np.cross(ahead, right), ahead)), np.asarray(place_m, dtype=float))


# Pictures that a cheap camera takes of printed sheets: perspective, lens distortion, rolling shutter, blur, noise.
#
# Every pixel looks along its own ray: the lens is undone by iteration, the ray meets the sheet's plane, and the print is read
# there. So no corner is placed by a formula that a detector could share.

Grey = NDArray[np.uint8]
FINER = 2  # rays a pixel along each axis: a print's edges are finer than a pixel
UNDISTORT_STEPS = 8
BACKGROUND_grey = 110.0
MARGIN_px = 6


@dataclass(frozen=True, slots=True)
class PrintedSheet:
    """A print in front of the camera: grey levels (rows, columns), its width, and camera_T_sheet.

    The sheet's origin is its centre; x to the right, y down, z into the paper.
    """

    grey: Grey
    width_m: float
    rotation: Array
    position_m: Array
    speed_m_s: Array = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True)
class Webcam:
    """A camera: focal length and centre in pixels, radial k1, k2 and tangential p1, p2, and what spoils its pictures."""

    width_px: int = 1280
    height_px: int = 720
    focal_px: tuple[float, float] = (930.0, 933.0)
    centre_px: tuple[float, float] = (648.0, 354.0)
    radial: tuple[float, float] = (-0.22, 0.06)
    tangential: tuple[float, float] = (0.0008, -0.0005)
    blur_px: float = 0.7
    noise_grey: float = 2.5
    readout_s: float = 0.0

    def picture(self, sheets: Sequence[PrintedSheet], draw: np.random.Generator, motion_s: float = 0.0) -> Grey:
        """The picture (height_px, width_px). `motion_s`: time of exposure, during which moving sheets smear."""
        seen = np.full((self.height_px, self.width_px), BACKGROUND_grey)
        seen += 15.0 * np.linspace(-1.0, 1.0, self.width_px)  # light from one side
        for sheet in sheets:
            self._add(seen, sheet, motion_s)
        seen = _blurred(seen, self.blur_px)
        seen += draw.normal(0.0, self.noise_grey, seen.shape)
        return np.clip(np.rint(seen), 0, 255).astype(np.uint8)

    def _add(self, seen: Array, sheet: PrintedSheet, motion_s: float) -> None:
        window = self._window(sheet)
        if window is None:
            return
        rows, columns = window
        v = np.arange(rows.start, rows.stop, dtype=np.float64)
        middle = self._rays(*np.meshgrid(np.arange(columns.start, columns.stop, dtype=np.float64), v))
        by_v, by_u = np.gradient(middle, axis=(0, 1))
        fine = (np.arange(FINER) + 0.5) / FINER - 0.5
        moments = np.linspace(-0.5, 0.5, 5) * motion_s if motion_s > 0.0 else np.zeros(1)
        light, ink = np.zeros(middle.shape[:2]), np.zeros(middle.shape[:2])
        for down, right, moment in product(fine, fine, moments):
            rays = middle + down * by_v + right * by_u
            x, y = _on_sheet(sheet, rays, self.readout_s * v / self.height_px + moment)
            grey, is_on = _read(sheet, x, y)
            light += grey
            ink += is_on
        share = 1.0 / (FINER**2 * len(moments))
        seen[rows, columns] *= 1.0 - share * ink
        seen[rows, columns] += share * light

    def _window(self, sheet: PrintedSheet) -> tuple[slice, slice] | None:
        """The part of the picture that can show the sheet; None if that is nothing."""
        rows, columns = sheet.grey.shape
        half = 0.5 * sheet.width_m * np.array([1.0, rows / columns])
        edge = np.linspace(-1.0, 1.0, 9)
        rim = np.concatenate(
            [np.column_stack((edge, 0 * edge + s)) for s in (-1, 1)] + [np.column_stack((0 * edge + s, edge)) for s in (-1, 1)]
        )
        places = (rim * half) @ sheet.rotation[:, :2].T + sheet.position_m
        if places[:, 2].min() < 0.02 or sheet.rotation[:, 2] @ sheet.position_m < 0.0:
            return None  # behind the camera, or seen from the back
        u, v = self._pixels(places[:, 0] / places[:, 2], places[:, 1] / places[:, 2])
        top, bottom = max(0, int(v.min()) - MARGIN_px), min(self.height_px, int(v.max()) + MARGIN_px)
        left, right = max(0, int(u.min()) - MARGIN_px), min(self.width_px, int(u.max()) + MARGIN_px)
        return (slice(top, bottom), slice(left, right)) if top + 1 < bottom and left + 1 < right else None

    def _bent(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Where the lens moves a ray's slopes."""
        (k1, k2), (p1, p2) = self.radial, self.tangential
        square = a * a + b * b
        swell = 1.0 + k1 * square + k2 * square * square
        return (
            a * swell + 2.0 * p1 * a * b + p2 * (square + 2.0 * a * a),
            b * swell + p1 * (square + 2.0 * b * b) + 2.0 * p2 * a * b,
        )

    def _pixels(self, a: Array, b: Array) -> tuple[Array, Array]:
        a, b = self._bent(a, b)
        return self.focal_px[0] * a + self.centre_px[0], self.focal_px[1] * b + self.centre_px[1]

    def _rays(self, u: Array, v: Array) -> Array:
        """Rays (rows, columns, 3) of pixels: the lens undone by fixed-point iteration."""
        wanted_a, wanted_b = ((u - self.centre_px[0]) / self.focal_px[0], (v - self.centre_px[1]) / self.focal_px[1])
        a, b = wanted_a, wanted_b
        for _ in range(UNDISTORT_STEPS):
            bent_a, bent_b = self._bent(a, b)
            a, b = a + wanted_a - bent_a, b + wanted_b - bent_b
        return np.stack((a, b, np.ones_like(a)), axis=2)


def _on_sheet(sheet: PrintedSheet, rays: Array, time_s: Array) -> tuple[Array, Array]:
    """Where rays meet the sheet, whose position in each row of rays is that at the row's own time."""
    place = sheet.position_m + time_s[:, None] * sheet.speed_m_s
    plane = np.tile(sheet.rotation[:, :2], (len(place), 1, 1))
    ways = np.linalg.inv(np.concatenate((plane, place[:, :, None]), axis=2))  # x r1 + y r2 + p = ray / w
    met = rays @ ways.transpose(0, 2, 1)
    return met[..., 0] / met[..., 2], met[..., 1] / met[..., 2]


def _read(sheet: PrintedSheet, x: Array, y: Array) -> tuple[Array, Array]:
    """Grey levels of the print at places of the sheet, and 1 where the sheet is; between its dots bilinear."""
    rows, columns = sheet.grey.shape
    dot_m = sheet.width_m / columns
    column, row = x / dot_m + 0.5 * columns - 0.5, y / dot_m + 0.5 * rows - 0.5
    is_on = (column > -0.5) & (column < columns - 0.5) & (row > -0.5) & (row < rows - 0.5)
    column, row = np.clip(column, 0, columns - 1.001), np.clip(row, 0, rows - 1.001)
    j, i = column.astype(np.intp), row.astype(np.intp)
    right, down = column - j, row - i
    g = sheet.grey.astype(np.float64)
    grey = (g[i, j] * (1 - right) + g[i, j + 1] * right) * (1 - down)
    grey += (g[i + 1, j] * (1 - right) + g[i + 1, j + 1] * right) * down
    contrast = 20.0 + grey * (210.0 / 255.0)  # ink is not black, paper not white
    return np.where(is_on, contrast, 0.0), is_on.astype(np.float64)


def _blurred(picture: Array, sd_px: float) -> Array:
    """Gaussian blur along rows, then along columns."""
    if sd_px <= 0.0:
        return picture
    reach = max(1, round(3.0 * sd_px))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sd_px) ** 2)
    weights /= weights.sum()
    for axis in (0, 1):
        padding = [(reach, reach) if k == axis else (0, 0) for k in (0, 1)]
        wide = np.pad(picture, padding, mode="edge")
        length = picture.shape[axis]
        picture = sum(
            (weight * np.take(wide, range(k, k + length), axis=axis) for k, weight in enumerate(weights)), np.zeros_like(picture)
        )
    return picture
