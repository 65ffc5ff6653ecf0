"""Measurements for an identification: joint angles, and a reference point for the tip of each pose."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from calib.arm_problem.frames import Frame
from calib.arrays import Array, frozen
from calib.errors import UnusablePointsError


@dataclass(frozen=True, slots=True)
class Correction:
    """One effect behind the encoder, linear in its parameter: joint angle = encoder angle + parameter * slope_rad.

    `slope_rad` (m, n) per unit of the parameter; e.g. the encoder angle itself for a scale, -flank / 2 for a backlash's
    width. `slope_m` (m, 3): displacement of the tip by the effect besides joint angles (flexure), and `turn_rad` (m, 3) turn of
    the last link, base frame. `bound`, `typical`, `sd` as of a Parameter;
    `made`: the value that the part was made to have.
    """

    name: str
    unit: str
    slope_rad: Array
    bound: float
    nominal: float = 0.0
    typical: float = 0.0
    slope_m: Array | None = None
    turn_rad: Array | None = None
    sd: float = math.inf
    made: float = 0.0

    def chosen(self, keep: npt.NDArray[np.intp]) -> Correction:
        """The correction at these poses."""
        tip, turn = (None if one is None else frozen(one[keep]) for one in (self.slope_m, self.turn_rad))
        return dataclasses.replace(self, slope_rad=frozen(self.slope_rad[keep]), slope_m=tip, turn_rad=turn)


@dataclass(frozen=True, slots=True)
class Observations:
    """m poses. Arrays are read-only.

    q_rad (m, n) from the encoders; position_m (m, 3): where the tip was, in the frame frames[frame[i]];
    `setup` and `point` name each pose. `known_shift_m` (m, 3): displacement of the tip by the arm's present effects, besides
    joint angles; `known_turn_rad` (m, 3): turn of the last link by them, a rotation vector in the base frame.
    `rotation` (m, 3, 3): the measured target's orientation in the same frame, NaN where there is none, or None;
    an error of it counts as `lever_m` times its angle; `is_target_known`: the target's axes are the last link's. `covariance`
    (m, 2, 3, 3): of position and orientation in the frame's axes, NaN where nothing was measured; None: all points count alike.
    """

    q_rad: Array
    position_m: Array
    frame: npt.NDArray[np.intp]
    frames: tuple[Frame, ...]
    setup: tuple[str, ...] = ()
    point: tuple[str, ...] = ()
    corrections: tuple[Correction, ...] = field(default=())
    known_shift_m: Array | None = None
    rotation: Array | None = None
    lever_m: float = 0.0
    is_target_known: bool = False
    covariance: Array | None = None
    known_turn_rad: Array | None = None

    def __post_init__(self) -> None:
        """ValueError for inconsistent shapes, which are a programming error."""
        m = len(self.q_rad)
        if self.q_rad.ndim != 2 or self.position_m.shape != (m, 3) or self.frame.shape != (m,):
            raise UnusablePointsError(
                f"joint angles {self.q_rad.shape}, tips {self.position_m.shape} and frames {self.frame.shape}:"
                " expected (m, n), (m, 3) and (m,)"
            )

    @classmethod
    def of_tips(cls, q_rad: npt.ArrayLike, tip_m: npt.ArrayLike) -> Observations:
        """Tips (m, 3) measured in the base frame at joint angles (m, n)."""
        q, tip = frozen(q_rad), frozen(tip_m)
        return cls(q, tip, np.zeros(len(q), dtype=np.intp), (Frame.base(),))

    def __len__(self) -> int:
        """How many poses."""
        return len(self.q_rad)

    def rows_of(self, frame: int) -> npt.NDArray[np.intp]:
        """The poses whose reference is given in this frame."""
        return np.flatnonzero(self.frame == frame)

    def chosen(self, rows: npt.ArrayLike) -> Observations:
        """The poses of these rows (indices or a mask), with the same frames."""
        keep = np.arange(len(self))[np.asarray(rows)]
        return Observations(
            frozen(self.q_rad[keep]),
            frozen(self.position_m[keep]),
            self.frame[keep],
            self.frames,
            tuple(self.setup[k] for k in keep) if self.setup else (),
            tuple(self.point[k] for k in keep) if self.point else (),
            tuple(c.chosen(keep) for c in self.corrections),
            None if self.known_shift_m is None else frozen(self.known_shift_m[keep]),
            None if self.rotation is None else frozen(self.rotation[keep]),
            self.lever_m,
            self.is_target_known,
            None if self.covariance is None else frozen(self.covariance[keep]),
            None if self.known_turn_rad is None else frozen(self.known_turn_rad[keep]),
        )

    @property
    def turned_rows(self) -> npt.NDArray[np.intp]:
        """The poses with a measured orientation."""
        if self.rotation is None:
            return np.zeros(0, dtype=np.intp)
        return np.flatnonzero(np.isfinite(self.rotation[:, 0, 0]))
