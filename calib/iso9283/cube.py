"""The test cube, ISO 9283:1998 clause 6.8: its diagonal plane and the five poses on it.

Corners C1 .. C4 go round the upper face, C5 .. C8 lie below them. Seen from above, C1 is at -x -y, C2 at -x +y,
C3 at +x +y, C4 at +x -y (which corner is C1 is our choice). The plane through C1, C2, C7, C8 is used: from the edge
above and near the base to the edge below and far from it, for a cube that stands in front of the arm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.iso9283.criteria.checks import above_zero, position

Point = tuple[float, float, float]
FROM_THE_ENDS = 0.1  # of a diagonal's length: where P2 .. P5 are; the standard: 10 % +- 2 %
POSES = ("P1", "P2", "P3", "P4", "P5")
_CORNERS = (
    (-1, -1, 1),
    (-1, 1, 1),
    (1, 1, 1),
    (1, -1, 1),
    (-1, -1, -1),
    (-1, 1, -1),
    (1, 1, -1),
    (1, -1, -1),
)


@dataclass(frozen=True, slots=True)
class TestCube:
    """A cube with edges along the base frame's axes: centre and edge length in m."""

    __test__ = False  # not a test of pytest's

    centre_m: Point
    edge_m: float

    def __post_init__(self) -> None:
        """Iso9283Error for an invalid centre or edge."""
        position(self.centre_m, "test cube, centre")
        above_zero(self.edge_m, "test cube, edge")

    def corner(self, number: int) -> Array:
        """C1 .. C8 (3,) by number."""
        return np.asarray(self.centre_m) + 0.5 * self.edge_m * np.array(_CORNERS[number - 1])

    def poses(self) -> dict[str, Point]:
        """P1 in the middle, P2 .. P5 at a tenth of the diagonals from C1, C2, C7, C8: P2 and P4 on one diagonal."""
        ends = [self.corner(number) for number in (1, 2, 7, 8)]
        centre = np.asarray(self.centre_m)
        inner = [end + 2.0 * FROM_THE_ENDS * (centre - end) for end in ends]
        return {name: point_of(p) for name, p in zip(POSES, (centre, *inner), strict=True)}

    def on_plane(self, across: float, down: float) -> Point:
        """A point of the diagonal plane: `across` along y, `down` from the edge C1 C2 to C7 C8, each -1 .. 1."""
        half = 0.5 * self.edge_m
        return point_of(np.asarray(self.centre_m) + half * np.array([down, across, -down]))

    def grid(self, count: int) -> Array:
        """A grid of points in the cube (count^3, 3), its corners first."""
        steps = np.linspace(-1.0, 1.0, count)
        inner = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        return np.asarray(self.centre_m) + 0.5 * self.edge_m * np.concatenate([np.array(_CORNERS), inner])


def point_of(values: Array) -> Point:
    """A position (3,) as three floats."""
    x, y, z = (float(v) for v in values)
    return x, y, z
