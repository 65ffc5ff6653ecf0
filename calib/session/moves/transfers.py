"""Moves between points: up along the board's normal, and across. The drives never take the tip down to the board."""

from __future__ import annotations

from collections.abc import Sequence

from calib.boards.boards import BoardPose
from calib.session.moves.approach import above_points
from calib.session.moves.clear_paths import ClearPaths
from calib.session.moves.ports import ArmPort, Geometry, Vector

FIRST_LIFT_m = 0.01  # out of the cavity first: a short joint move is straight to a tenth of a millimetre
NEAR = 0.9  # of the height above: below this, the arm lifts before any move


class Transfers:
    """Moves the arm from above one point to above the next."""

    def __init__(
        self,
        geometry: Geometry,
        arm: ArmPort,
        approach_m: float,
        window_s: float,
        ways: ClearPaths | None = None,
    ) -> None:
        """`ways`: finds paths around the board; without it, every path is assumed to be clear."""
        self._geometry, self._arm, self._ways = geometry, arm, ways
        self._approach_m, self._window_s = approach_m, window_s
        self._q_rad = tuple(arm.average(window_s).q_rad)
        self._normal: Vector | None = None  # of the board at which the arm is, None if it is free

    @property
    def is_at_point(self) -> bool:
        """Whether the tip is, or may be, at a point; then the arm lifts before any move."""
        return self._normal is not None

    def stands_at(self, normal: Vector) -> None:
        """Note that the tip is at a point of a board with this normal."""
        self._normal = normal

    def stands_over(self, origin_m: Vector, normal: Vector) -> None:
        """Note that the tip may be at a point, if it is lower than the points above this board's cavities."""
        height_m = sum(
            n * (a - b) for n, a, b in zip(normal, self._geometry.tip(self._q_rad), origin_m, strict=True)
        )
        if height_m < NEAR * self._approach_m:
            self._normal = normal

    def plan(
        self,
        tip_m: Vector,
        normal: Vector,
        approach: int = 1,
        approaches: int = 1,
        posture_rad: Sequence[float] | None = None,
    ) -> tuple[float, ...]:
        """Angles above a point, nearest to the posture, or to the geometry's; ArmError if it or the point is out of reach."""
        near = self._geometry.posture(self._q_rad) if posture_rad is None else posture_rad
        starts = above_points(self._geometry, tip_m, normal, self._approach_m, near, approaches)
        above = tuple(self._geometry.nearest(starts[approach - 1], near))
        self._geometry.nearest(tip_m, above)
        return above

    def lift(self) -> bool:
        """Move straight up from the present point, if at one; return whether it was.

        Starts from the arm's own pose, because an uncalibrated arm's cavities are off.
        """
        if self._normal is None:
            return False
        q_rad: Sequence[float] = self._arm.average(self._window_s).q_rad
        x, y, z = self._geometry.tip(q_rad)
        nx, ny, nz = self._normal
        for up_m in (FIRST_LIFT_m, self._approach_m):
            q_rad = self._geometry.nearest((x + up_m * nx, y + up_m * ny, z + up_m * nz), q_rad)
            self._arm.move_to_q(q_rad)
        self._q_rad, self._normal = tuple(q_rad), None
        return True

    def go(self, q_rad: Sequence[float], board: BoardPose | None = None) -> None:
        """Move up, and across to these angles, clear of the board. ArmError, after the lift, if there is no clear path."""
        self.lift()
        stops = [tuple(q_rad)] if self._ways is None else self._ways.stops(self._q_rad, q_rad, board)
        for stop in stops:
            self._arm.move_to_q(stop)
            self._q_rad = stop
