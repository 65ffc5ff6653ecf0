"""Corners of a dark square below a pixel: a line along each side, where the grey level changes most, and where they meet.

Corner detectors pull the corner of a square inwards or outwards by some tenths of a pixel, all four alike: the square then
looks too far or too near. Lines along the sides have no such error.
"""

from __future__ import annotations

import numpy as np

from calib.arrays import Array
from calib.vision.opencv import Picture

ENDS = 0.12  # of a side next to each corner, where the other side disturbs
MODULE = 1.0 / 8.0  # of a side: width of a tag's dark border, which the search must not leave
REACH_px = 5.0
STEP_px = 0.25
ROUNDS = 3
LEAST_SIDE_px = 16.0  # below it, a border of two pixels has no inside


def refined_square(picture: Picture, corners_px: Array) -> Array:
    """Corners (4, 2) refined; unchanged where the square is too small or a side has no edge."""
    found = np.array(corners_px)
    for _ in range(ROUNDS):
        sides = [_line(picture, found[k], found[(k + 1) % 4]) for k in range(4)]
        lines = [side for side in sides if side is not None]
        if len(lines) < 4:
            return corners_px
        met = np.cross(np.array([lines[k - 1] for k in range(4)]), np.array(lines))
        found = met[:, :2] / met[:, 2:]
    moved = np.abs(found - corners_px).max()
    return found if np.isfinite(moved) and moved < REACH_px else corners_px


def _line(picture: Picture, start: Array, end: Array) -> Array | None:
    """The line (3,) n . (u, v) + c = 0 along the edge between two corners."""
    along = end - start
    length = float(np.linalg.norm(along))
    if length < LEAST_SIDE_px:
        return None
    along = along / length
    outward = np.array([along[1], -along[0]])  # corners go clockwise in a picture whose y points down
    reach = min(REACH_px, 0.8 * MODULE * length)
    places = start + np.linspace(ENDS, 1.0 - ENDS, max(8, int(length)))[:, None] * (end - start)
    offsets = np.arange(-reach, reach + STEP_px, STEP_px)
    grey = _bilinear(picture, places[:, None] + offsets[:, None] * outward)
    slope = np.clip(np.diff(grey, axis=1), 0.0, None)  # from dark to light, going outwards
    weight = slope**2  # noise on both sides counts less than the edge
    strength = weight.sum(axis=1)
    is_edge = strength > 0.1 * np.median(strength)
    if is_edge.sum() < 5 or float(np.median(strength)) <= 0.0:
        return None
    middle = 0.5 * (offsets[1:] + offsets[:-1])
    at = (weight @ middle)[is_edge] / strength[is_edge]
    return _fitted(places[is_edge] + at[:, None] * outward)


def _fitted(points: Array) -> Array:
    """The line nearest to points (k, 2), twice, the second time without those far from it."""
    for _ in range(2):
        centre = points.mean(axis=0)
        normal = np.linalg.svd(points - centre, full_matrices=False)[2][1]
        off = np.abs((points - centre) @ normal)
        points = points[off <= 3.0 * max(float(np.median(off)), 1e-3)]
    return np.array([*normal, -normal @ centre])


def _bilinear(picture: Picture, places: Array) -> Array:
    """Grey levels at places (..., 2) as (u, v); beyond the rim those of the rim."""
    height, width = picture.shape
    u, v = np.clip(places[..., 0], 0, width - 1.001), np.clip(places[..., 1], 0, height - 1.001)
    j, i = u.astype(np.intp), v.astype(np.intp)
    right, down = u - j, v - i
    g = picture.astype(np.float64)
    upper = g[i, j] * (1 - right) + g[i, j + 1] * right
    return np.asarray(upper * (1 - down) + (g[i + 1, j] * (1 - right) + g[i + 1, j + 1] * right) * down)
