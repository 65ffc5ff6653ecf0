"""The body of an arm as capsules in the frame of its cell: base, links, and the slender tool at its end."""

import math
from collections.abc import Sequence

from control.kinematics.corners import Corners
from control.model.cell import Placed
from control.safety.collision import Capsule, capsule, least_gap

Capsules = tuple[Capsule, ...]
BASE, TOOL = "base", "tool"
LEAST_m = 1e-9  # a shorter link has no direction


class ArmBody:
    """Capsules of one arm with one of its tools: [[link]] radius_m is how thick the links are, [limits] base_radius_m the base.

    `names` of the capsules: base, link by number, tool. The tool is the last `tool_length_m` before the tip, a line.
    """

    def __init__(self, placed: Placed, tool_length_m: float) -> None:
        arm = placed.arm
        corners = Corners(arm)
        self._at, self._start_m = corners.at, corners.start_m
        self._origin_m, self._rotation = placed.origin_m, placed.rotation
        self._radii_m = corners.radii_m
        self._tool_m = tool_length_m
        top_m = (0.0, 0.0, max(arm.links[0].d_m, 0.0))
        self._base = capsule(placed.in_cell((0.0, 0.0, 0.0)), placed.in_cell(top_m), arm.limits.base_radius_m)
        self.names = (BASE, *(f"link {number}" for number in corners.joints), TOOL)
        self.joints = (0, *corners.joints, corners.joints[-1])
        rest = arm.rest.q_rad if arm.rest is not None else _middles(arm.limits_rad)
        self.own_pairs = self._meeting_pairs(self.at(rest))

    def at(self, q_rad: Sequence[float]) -> Capsules:
        """The capsules of a pose (joint angles) in the frame of the cell."""
        (ox, oy, oz), ((a, b, c), (d, e, f), (g, h, i)) = self._origin_m, self._rotation
        x, y, z = self._start_m
        last = ox + a * x + b * y + c * z, oy + d * x + e * y + f * z, oz + g * x + h * y + i * z
        found = [self._base]
        corners, radii_m = self._at(*q_rad), self._radii_m
        tip = len(corners) - 1
        for k, (x, y, z) in enumerate(corners):
            here = ox + a * x + b * y + c * z, oy + d * x + e * y + f * z, oz + g * x + h * y + i * z
            if k == tip:
                # The last link ends where the tool begins.
                share = min(1.0, self._tool_m / max(math.dist(last, here), self._tool_m, LEAST_m))
                (px, py, pz), (qx, qy, qz) = last, here
                neck = qx + share * (px - qx), qy + share * (py - qy), qz + share * (pz - qz)
                found.append(capsule(last, neck, radii_m[k]))
                last = neck
            found.append(capsule(last, here, radii_m[k] if k < tip else 0.0))
            last = here
        return tuple(found)

    def _meeting_pairs(self, rest: Capsules) -> tuple[tuple[int, int], ...]:
        """Pairs of the arm's own capsules that may meet: at least two joints between them, and apart in the rest pose.

        The base is left to control.safety.workspace, which knows its axis. Neighbours in the chain always touch.
        """
        pairs = [
            (i, j)
            for i in range(1, len(rest))
            for j in range(i + 2, len(rest))
            if self.joints[j] - self.joints[i] >= 2
        ]
        return tuple(pair for pair in pairs if not least_gap(rest, rest, (pair,), 0.0).gap_m < 0.0)


def pairs_between(one: ArmBody, other: ArmBody) -> tuple[tuple[int, int], ...]:
    """Pairs of capsules of two arms that must not meet: all but base and base, and the tools, which may touch."""
    return tuple(
        (i, j)
        for i, first in enumerate(one.names)
        for j, second in enumerate(other.names)
        if not (first == second == BASE or first == second == TOOL)
    )


def _middles(limits_rad: Sequence[tuple[float, float]]) -> tuple[float, ...]:
    return tuple(
        0.5 * (lower + upper) if math.isfinite(lower + upper) else 0.0 for lower, upper in limits_rad
    )
