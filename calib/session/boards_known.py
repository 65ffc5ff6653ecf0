"""Positions of the cavities: from arm.toml, from the camera, or unknown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calib.arm_problem.assembly import base_frame_of
from calib.boards import FEWEST_TO_NAME, BoardPose, Markers, Registration, register_boards
from calib.design.candidates import OTHER_TILTS, tilted
from calib.errors import RegistrationError, SessionError
from calib.points.points import Points
from calib.session.moves import Vector
from calib.session.plan import Board, SessionPlan, Target
from control.model import table as tables
from control.model.arm import Arm

UP: Vector = (0.0, 0.0, 1.0)


class Boards:
    """The cavities of a session's setups. A measured board becomes known once enough of its cavities were measured.

    `poses` are in the arm's own base frame, for moving; table and camera may use another base frame, given by the arm's
    `base_frame` effect.
    """

    def __init__(self, arm: Arm, plan: SessionPlan) -> None:
        """SessionError if the arm's table lacks a cavity, MissingModel if its pose or the table is missing."""
        self.kind: Board = plan.board
        self.cavities_m: dict[str, Vector] = {}
        self.poses: dict[str, BoardPose] = {}
        self._references: dict[str, BoardPose] = {}
        self._base = base_frame_of(arm)
        setups = dict.fromkeys(target.setup for target in plan.targets if not target.is_free)
        if not setups:
            return
        table = tables.table_of(arm)
        self.cavities_m = tables.board_cavities(table)
        _require_cavities(plan.targets, self.cavities_m)
        if self.kind == "known":
            origin = np.array(tables.board_origin(table))
            for setup in setups:
                _require_tilt(setup)
                self._place(setup, BoardPose(tilted(table, setup), origin))

    def is_placed(self, setup: str) -> bool:
        """Whether the arm can be sent to the cavities of this setup."""
        return setup in self.poses

    def tip_m(self, target: Target) -> Vector:
        """A cavity in the arm's base frame."""
        return self._cavity_m(self.poses, target)

    def reference_m(self, target: Target) -> Vector:
        """A cavity in the base frame of table and camera, as in a record."""
        return self._cavity_m(self._references, target)

    def _cavity_m(self, poses: Mapping[str, BoardPose], target: Target) -> Vector:
        x, y, z = poses[target.setup].to_base(np.array([self.cavities_m[target.point]]))[0].tolist()
        return x, y, z

    def _place(self, setup: str, pose: BoardPose) -> None:
        base = self._base
        self._references[setup] = pose
        origin_m = base.to_base(pose.origin_m[None])[0]
        self.poses[setup] = BoardPose(np.asarray(base.rotation @ pose.rotation), origin_m)

    def origin_m(self, setup: str) -> Vector:
        """The board's origin in the base frame."""
        x, y, z = self.poses[setup].origin_m.tolist()
        return x, y, z

    def normal(self, setup: str) -> Vector:
        """The board's normal in the base frame; up if unknown."""
        if setup not in self.poses:
            return UP
        x, y, z = self.poses[setup].rotation[:, 2].tolist()
        return x, y, z

    def needs_seeing(self, setup: str) -> bool:
        """Whether cavities of this setup must be measured by the camera first."""
        return self.kind == "measured" and setup not in self.poses

    def best_to_see(self, left: Sequence[Target], points: Points | None, setup: str) -> Target:
        """Of the remaining targets in a setup, the cavity farthest from those measured."""
        here = [target for target in left if target.setup == setup]
        seen = {*self._seen(points, setup).marker} if points is not None else set()
        places = np.array(
            [self.cavities_m[name] for name in seen] or [np.mean([*self.cavities_m.values()], axis=0)]
        )

        def distance_m(target: Target) -> float:
            return float(np.min(np.linalg.norm(places - self.cavities_m[target.point], axis=1)))

        return max(here, key=distance_m)

    def register(self, points: Points, setup: str, is_last: bool) -> Registration | None:
        """Place the board by the tips that the camera saw, if they are enough; with fewer than five only if
        no more can come (`is_last`). RegistrationError where they do not agree with the board.
        """
        seen = self._seen(points, setup)
        names = set(seen.marker)
        if len(names) < 3 or (len(names) < FEWEST_TO_NAME and not is_last):
            return None
        found = register_boards(seen, self.cavities_m)[setup]
        if len(names) - len(found.outliers) < 3:
            raise RegistrationError(f"setup {setup}: fewer than three markers agree; measure them again")
        self._place(setup, BoardPose(found.rotation, found.origin_m))
        return found

    def _seen(self, points: Points, setup: str) -> Markers:
        return markers_of(points.chosen([k for k in range(len(points)) if points.setup[k] == setup]))


def markers_of(points: Points) -> Markers:
    """The measured tips in cavities, as markers."""
    rows = np.flatnonzero(np.isfinite(points.tip_m).all(axis=1) & (np.array(points.setup) != "free"))
    chosen = points.chosen(rows)
    return Markers(chosen.setup, chosen.point, chosen.tip_m)


def _require_tilt(setup: str) -> None:
    tilts = (*tables.SETUPS, *OTHER_TILTS)
    if setup not in tilts:
        raise SessionError(
            f'setup of a board with a known pose: expected one of {", ".join(tilts)}, got "{setup}"'
        )


def _require_cavities(targets: Sequence[Target], cavities_m: Mapping[str, Vector]) -> None:
    for target in targets:
        if not target.is_free and target.point not in cavities_m:
            some = ", ".join(list(cavities_m)[:8])
            raise SessionError(f"the table has no cavity {target.point} ({target.name}); it has {some}, ...")
