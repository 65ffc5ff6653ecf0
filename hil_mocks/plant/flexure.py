"""A link that bends: the effect `link_flexure`, as a stiff joint in the middle of the link.

Euler-Bernoulli cantilever of length L and bending stiffness EI, the same in both planes, with a transverse force F and a
moment M at its end: it deflects there by F L^3/(3 EI) + M L^2/(2 EI) and turns by F L^2/(2 EI) + M L/(EI). Seen from the middle,
where the moment is M + F L/2, the two decouple: the far half turns by (M + F L/2) / (EI/L), and its middle deflects by
F / (12 EI/L^3). So two hinges of EI/L and two slides of 12 EI/L^3, across the beam at its middle, are the cantilever exactly,
for small deflections. Along and about its axis the beam is rigid.

The link's own mass m at a distance a from the root (F = m g across) bends it by F a^2 (3 L - a)/(6 EI) and F a^2/(2 EI) at the
end. So does the part m a^2/(2 L (b - L/2)) of it that rides on the far half, at b = L (2 L - a)/(3 L - 2 a) from the root; the
rest stays on the near half, where it keeps the centre of mass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil_mocks.errors import MockError
from hil_mocks.plant.geometry import LinkFrame, Matrix

LOSS_S = 2e-4  # damping over stiffness: 2 % of critical at 30 Hz, as of a bolted aluminium link
_SHORTEST_M = 0.01
_LEAST_INERTIA_kg_m2 = 1e-6


@dataclass(frozen=True, slots=True)
class PointMass:
    """A part of a link's mass and its position in the link's frame."""

    mass_kg: float
    place_m: Matrix


@dataclass(frozen=True, slots=True)
class Beam:
    """A bending link in its own frame: its middle, two transverse axes, and the stiffness of its joints."""

    middle_m: Matrix  # (3,)
    across: tuple[Matrix, Matrix]
    length_m: float
    root_m: Matrix
    along: Matrix
    EI_Nm2: float

    @property
    def hinge_Nm_rad(self) -> float:
        """Stiffness of each hinge."""
        return self.EI_Nm2 / self.length_m

    @property
    def slide_N_m(self) -> float:
        """Stiffness of each slide."""
        return 12.0 * self.EI_Nm2 / self.length_m**3


def beam(root_m: Matrix, end_m: Matrix, EI_Nm2: float, where: str) -> Beam:
    """The beam between two points of a link's frame. MockError if they are too close."""
    way = end_m - root_m
    length = float(np.linalg.norm(way))
    if length < _SHORTEST_M:
        raise MockError(
            f"{where}: link_flexure bends {length:.4f} m of link; at least {_SHORTEST_M} m are needed."
        )
    along = way / length
    helper = np.eye(3)[int(np.argmin(np.abs(along)))]
    first = np.cross(along, helper)
    first /= np.linalg.norm(first)
    across = (first, np.cross(along, first))
    return Beam(root_m + 0.5 * way, across, length, root_m, along, EI_Nm2)


def ends_of(
    i: int, frames: Sequence[LinkFrame], is_revolute: Sequence[bool], is_standard: bool, tool_m: Matrix
) -> tuple[Matrix, Matrix]:
    """Ends of bending link i in its own frame: its joint, and the next one or the tip, including fixed links between.

    `frames` of all links in their parents'. By the standard convention a link's joint is at its parent's origin, by the modified
    one at its own.
    """
    is_at_origin = is_revolute[i] and not is_standard
    root_m = np.zeros(3) if is_at_origin else -frames[i].rotation.T @ frames[i].position_m
    end_m, rotation = np.zeros(3), np.eye(3)
    for frame, is_joint in zip(frames[i + 1 :], is_revolute[i + 1 :], strict=True):
        if is_joint and is_standard:
            return root_m, end_m
        end_m = end_m + rotation @ frame.position_m
        if is_joint:
            return root_m, end_m
        rotation = rotation @ frame.rotation
    return root_m, end_m + rotation @ tool_m


def split_mass(of: Beam, mass_kg: float, com_m: Matrix) -> tuple[PointMass, PointMass]:
    """A link's own mass as two points, on the near and on the far half of its beam, with the same centre of mass."""
    L = of.length_m
    offset = com_m - of.root_m
    a = min(max(float(offset @ of.along), 0.0), L)
    aside = offset - a * of.along
    b = L * (2.0 * L - a) / (3.0 * L - 2.0 * a)
    far_kg = mass_kg * a**2 / (2.0 * L * (b - 0.5 * L))
    near_kg = mass_kg - far_kg
    near_at = (mass_kg * a - far_kg * b) / near_kg if near_kg > 1e-12 else 0.0
    near, far = (of.root_m + at * of.along + aside for at in (near_at, b))
    return PointMass(near_kg, near), PointMass(far_kg, far)


def remaining_inertia(inertia_kg_m2: Matrix, com_m: Matrix, parts: tuple[PointMass, PointMass]) -> Matrix:
    """Remaining principal inertia (3,) of a link after subtracting that of its two mass points."""
    left: Matrix = np.array(inertia_kg_m2, dtype=float)
    for part in parts:
        r = part.place_m - com_m
        left -= part.mass_kg * (float(r @ r) - r**2)
    least: Matrix = np.maximum(left, _LEAST_INERTIA_kg_m2)
    return least
