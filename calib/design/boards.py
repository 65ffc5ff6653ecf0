"""Poses of the calibration board in each setup, for planning."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.frames import Frame
from calib.arrays import Array, frozen
from calib.boards.rigid import best_motion
from calib.errors import CalibrationError
from calib.points.points import Points
from control.model.arm import Arm, Table
from control.model.table import SETUPS, board_cavities, board_rotation

OTHER_TILTS = ("roll-", "pitch-", "roll+pitch")  # the opposite tilts, and both tilts at once
FLAT = 5e-3  # spread of cavities across their best line, as a share of that along it


@dataclass(frozen=True, slots=True)
class PlacedBoard:
    """The board of one setup: base_R_board (3, 3), origin_m (3,), cavities [m] in its own frame.

    `is_known`: the pose is known (or measured) and not identified. `has_plane`: the board's plane is
    approximately known; False if only collinear cavities were recorded.
    """

    setup: str
    rotation: Array
    origin_m: Array
    cavities_m: Mapping[str, tuple[float, float, float]]
    is_known: bool
    has_plane: bool = True

    @property
    def names(self) -> list[str]:
        """The cavities' names."""
        return list(self.cavities_m)

    @property
    def positions_m(self) -> Array:
        """The cavities in the base frame, (c, 3)."""
        local = np.array(list(self.cavities_m.values())).reshape(-1, 3)
        return np.asarray(local @ self.rotation.T + self.origin_m)

    @property
    def reach_m(self) -> float:
        """Distance of the outermost cavity from the board's origin, in its plane."""
        return max((math.hypot(x, y) for x, y, _ in self.cavities_m.values()), default=0.0)

    @property
    def frame(self) -> Frame:
        """The frame for the identification."""
        return Frame(f"table_{self.setup}", frozen(self.rotation), frozen(self.origin_m))


def usual_setups(arm: Arm, points: Points | None, measured: Mapping[str, Frame]) -> list[str]:
    """The default setups to plan for: the table's own, measured ones, and those of the points."""
    if arm.table is None:
        return []
    own = ["normal"] if arm.table.origin_m is not None else []
    own += ["roll"] if own and arm.table.roll_tilt_rad else []
    own += ["pitch"] if own and arm.table.pitch_tilt_rad else []
    seated = (
        []
        if points is None
        else [s for s, p in zip(points.setup, points.point, strict=True) if p in _all(arm)]
    )
    return list(dict.fromkeys([*own, *measured, *(setup for setup in seated if setup != "free")]))


def placed_boards(
    arm: Arm, setups: Sequence[str], points: Points | None, measured: Mapping[str, Frame]
) -> dict[str, PlacedBoard]:
    """The board in each of the setups. CalibrationError for a setup with an unknown board pose.

    Measured poses take precedence over the arm's [table], and that over an estimate from the setup's points.
    """
    if setups and arm.table is None:
        raise CalibrationError(
            f"setup {setups[0]}: arm {arm.name} has no [table]; add one, or plan free poses only (--only free)"
        )
    return {setup: _placed(arm, setup, points, measured) for setup in setups}


def boards_in_the_way(
    arm: Arm, taken: Points | None, measured: Mapping[str, Frame], planned: Mapping[str, PlacedBoard]
) -> tuple[PlacedBoard, ...]:
    """Possible poses of the board while free poses are recorded: in every setup with a known pose."""
    found = dict(planned)
    for setup in usual_setups(arm, taken, measured):
        with contextlib.suppress(CalibrationError):
            found.setdefault(setup, _placed(arm, setup, taken, measured))
    return tuple(found.values())


def _placed(arm: Arm, setup: str, points: Points | None, measured: Mapping[str, Frame]) -> PlacedBoard:
    table = arm.table or Table()
    if setup in measured:
        return PlacedBoard(
            setup, measured[setup].rotation, measured[setup].origin_m, _all(arm), is_known=True
        )
    fitted = None if table.known_pose else _fitted(arm, setup, points)
    if fitted is not None:
        return fitted
    if setup not in (*SETUPS, *OTHER_TILTS):
        raise CalibrationError(
            f"setup: expected some of {', '.join((*SETUPS, *OTHER_TILTS))}, or a setup with a measured board or with"
            f' recorded points; got "{setup}"'
        )
    if table.origin_m is None:
        raise CalibrationError(
            f"setup {setup}: the board's position is unknown: record three cavities and give them with --points,"
            " register the board, or write its approximate position as origin_m in [table]"
        )
    return PlacedBoard(
        setup, tilted(table, setup), np.array(table.origin_m), _all(arm), is_known=table.known_pose
    )


def tilted(table: Table, setup: str) -> Array:
    """base_R_board (3, 3) of one of the table's setups or of OTHER_TILTS."""
    if setup in SETUPS:
        return np.array(board_rotation(table, setup))
    roll = {"roll-": -1.0, "roll+pitch": 1.0}.get(setup, 0.0) * table.roll_tilt_rad
    pitch = {"pitch-": -1.0, "roll+pitch": 1.0}.get(setup, 0.0) * table.pitch_tilt_rad
    c, s = math.cos(roll), math.sin(roll)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    c, s = math.cos(pitch), math.sin(pitch)
    return np.asarray(np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) @ about_x)


def _fitted(arm: Arm, setup: str, points: Points | None) -> PlacedBoard | None:
    """The board placed by the nominal arm's tips in its cavities; if they are collinear, only those cavities."""
    known = _all(arm)
    rows = (
        []
        if points is None
        else [k for k, s in enumerate(points.setup) if s == setup and points.point[k] in known]
    )
    if points is None or not rows:
        return None
    model = ArmModel(arm)
    local = np.array([known[points.point[k]] for k in rows])
    stands = best_motion(local, model.tips(model.nominal_dh, points.q_rad[rows]))
    spread = np.linalg.svd(local - local.mean(axis=0), compute_uv=False)
    seen = {points.point[k] for k in rows}
    is_whole = len(spread) > 1 and spread[1] > FLAT * spread[0] > 0.0
    cavities = {name: place for name, place in known.items() if is_whole or name in seen}
    return PlacedBoard(setup, stands.rotation, stands.shift_m, cavities, is_known=False, has_plane=is_whole)


def _all(arm: Arm) -> dict[str, tuple[float, float, float]]:
    return {} if arm.table is None else board_cavities(arm.table)
