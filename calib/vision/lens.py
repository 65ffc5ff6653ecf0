"""The lens of a camera: pinhole with radial and tangential distortion, and its exact derivatives.

    (a, b) = (X, Y) / Z,   s = a^2 + b^2,   g = 1 + k1 s + k2 s^2 + k3 s^3
    a' = a g + 2 p1 a b + p2 (s + 2 a^2),   b' = b g + p1 (s + 2 b^2) + 2 p2 a b
    u = fx a' + cx,   v = fy b' + cy

(Brown, Photogrammetric Engineering 37 (1971) 855; the order k1, k2, p1, p2, k3 is OpenCV's.) The camera's frame: x to the right
of the picture, y down, z along the view. Pixel centres have whole coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from calib.arrays import Array, frozen

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True, slots=True)
class Lens:
    """Values (9,) in the order of NAMES, of pictures of width_px by height_px.

    covariance (9, 9), zero where a value is not estimated; noise_px: standard deviation of one coordinate of a found corner.
    readout_s: from the first to the last row of a picture (rolling shutter), 0: all rows at once.
    """

    values: Array
    width_px: int
    height_px: int
    covariance: Array = field(default_factory=lambda: frozen(np.zeros((len(NAMES), len(NAMES)))))
    noise_px: float = 0.0
    readout_s: float = 0.0

    @property
    def matrix(self) -> Array:
        """Camera matrix (3, 3)."""
        fx, fy, cx, cy = self.values[:4]
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def distortion(self) -> Array:
        """Values k1, k2, p1, p2, k3."""
        return np.asarray(self.values[4:])

    @property
    def sd(self) -> Array:
        """Standard deviations (9,)."""
        return np.sqrt(np.diag(self.covariance))

    def project(self, points_m: Array) -> Array:
        """Pixels (k, 2) of points (k, 3) in the camera's frame."""
        return self.slopes(points_m)[0]

    def slopes(self, points_m: Array) -> tuple[Array, Array, Array]:
        """Pixels (k, 2), and their derivatives by the point (k, 2, 3) and by the values (k, 2, 9)."""
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = self.values
        z = points_m[:, 2]
        a, b = points_m[:, 0] / z, points_m[:, 1] / z
        s = a * a + b * b
        g, by_s = 1.0 + s * (k1 + s * (k2 + s * k3)), k1 + s * (2.0 * k2 + 3.0 * s * k3)
        bent = np.array(
            [a * g + 2 * p1 * a * b + p2 * (s + 2 * a * a), b * g + p1 * (s + 2 * b * b) + 2 * p2 * a * b]
        )
        cross = 2 * a * b * by_s + 2 * p1 * a + 2 * p2 * b
        by_ray = np.array(
            [
                [g + 2 * a * a * by_s + 2 * p1 * b + 6 * p2 * a, cross],
                [cross, g + 2 * b * b * by_s + 6 * p1 * b + 2 * p2 * a],
            ]
        )
        zero, one = np.zeros_like(a), np.ones_like(a)
        ray = np.array([[one, zero, -a], [zero, one, -b]]) / z
        focal = np.array([fx, fy])
        by_point = np.einsum("i,ijk,jlk->kil", focal, by_ray, ray)
        by_bend = np.array(
            [
                [a * s, a * s**2, 2 * a * b, s + 2 * a * a, a * s**3],
                [b * s, b * s**2, s + 2 * b * b, 2 * a * b, b * s**3],
            ]
        )
        by_values = np.zeros((len(a), 2, len(NAMES)))
        by_values[:, 0, 0], by_values[:, 1, 1] = bent
        by_values[:, 0, 2] = by_values[:, 1, 3] = 1.0
        by_values[:, :, 4:] = np.einsum("i,ijk->kij", focal, by_bend)
        return (focal[:, None] * bent).T + np.array([cx, cy]), by_point, by_values
