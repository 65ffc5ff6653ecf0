"""Measurements for an identification: joint angles, a reference point for the tip of each pose, and the frames of these points: a
board in one setup, or the base frame of camera and table.

A deviation of a frame is a translation t and a rotation vector w about the centre of its points:
p_base = anchor + t + exp([w]x) R0 (p - centre), anchor = R0 centre + origin. Rotating about the centre of the points
decouples translations and rotations.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, frozen
from calib.errors import UnusablePointsError

AXES = ("x", "y", "z", "rx", "ry", "rz")
AXIS_UNITS = ("m", "m", "m", "rad", "rad", "rad")


@dataclass(frozen=True, slots=True)
class Frame:
    """Prior base_T_frame: rotation (3, 3), origin_m (3,); identified if `is_free`.

    `is_placed` is False if its pose is unknown: the identification then starts from the arm's prediction.
    """

    name: str
    rotation: Array
    origin_m: Array
    is_free: bool = False
    is_placed: bool = True

    @classmethod
    def unplaced(cls, name: str) -> Frame:
        """A frame with an unknown pose."""
        return cls(name, frozen(np.eye(3)), frozen(np.zeros(3)), is_free=True, is_placed=False)

    @classmethod
    def base(cls, is_free: bool = False) -> Frame:
        """The arm's base frame, as used by camera or table."""
        return cls("base", frozen(np.eye(3)), frozen(np.zeros(3)), is_free)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """base_x ... base_rz: a translation [m] and a rotation [rad] in the base frame's axes."""
        return tuple(f"{self.name}_{axis}" for axis in AXES)

    def to_base(self, points_m: Array) -> Array:
        """Points (m, 3) of the frame in the base frame."""
        return np.asarray(points_m @ self.rotation.T + self.origin_m)

    def moved(self, centre_m: Array, move: Array) -> Frame:
        """The frame after a deviation (6,): t and w about `centre_m` (3,), a point of the frame."""
        turned = rotation_of(move[3:]) @ self.rotation
        origin = self.to_base(centre_m) + move[:3] - turned @ centre_m
        return Frame(self.name, frozen(turned), frozen(origin), self.is_free)


def seen_less_far_m(place_m: Array, moved: Array) -> Array:
    """Places (m, 3) less where they are taken to be once their frame has moved by (6,): a translation and a rotation vector."""
    return np.asarray(place_m - place_m @ rotation_of(moved[3:]).T - moved[:3])


def rotation_of(vector_rad: Array) -> Array:
    """exp([w]x), (3, 3): Rodrigues' formula."""
    angle = float(np.linalg.norm(vector_rad))
    cross = cross_matrix(vector_rad)
    if angle < 1e-8:
        return np.asarray(np.eye(3) + cross + 0.5 * cross @ cross)
    return np.asarray(np.eye(3) + np.sin(angle) / angle * cross + (1.0 - np.cos(angle)) / angle**2 * cross @ cross)


def rotation_vector(rotation: Array) -> Array:
    """The w, (3,), |w| <= pi, with exp([w]x) = rotation (3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


def mean_rotation(rotations: Array) -> Array:
    """The rotation (3, 3) nearest to rotations (r, 3, 3) in the least squares sense: their projected mean (Moakher, 2002)."""
    left, _, right = np.linalg.svd(rotations.mean(axis=0))
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


def left_jacobian(vector_rad: Array) -> Array:
    """J (3, 3) with exp([w + dw]x) = exp([J dw]x) exp([w]x) to first order (Barfoot, State Estimation for Robotics)."""
    angle = float(np.linalg.norm(vector_rad))
    cross = cross_matrix(vector_rad)
    if angle < 1e-4:
        return np.asarray(np.eye(3) + 0.5 * cross + cross @ cross / 6.0)
    return np.asarray(np.eye(3) + (1.0 - np.cos(angle)) / angle**2 * cross + (angle - np.sin(angle)) / angle**3 * cross @ cross)


def turned_slope(vector_rad: Array, torque: Array) -> Array:
    """Derivative (3, 3) of J(w)' t by w, with the J of `left_jacobian` and a fixed t (3,).

    J' t = t - a w x t + b w x (w x t), with a = (1 - cos |w|) / |w|^2 and b = (|w| - sin |w|) / |w|^3.
    """
    w, square = vector_rad, float(vector_rad @ vector_rad)
    if square < 0.01:  # where the quotients lose their digits; the next terms are below 1e-11
        a, b = 0.5 - square / 24.0 + square**2 / 720.0, 1.0 / 6.0 - square / 120.0 + square**2 / 5040.0
        by_a = -1.0 / 12.0 + square / 180.0 - square**2 / 6720.0
        by_b = -1.0 / 60.0 + square / 1260.0 - square**2 / 60480.0
    else:
        angle = math.sqrt(square)
        a, b = (1.0 - math.cos(angle)) / square, (angle - math.sin(angle)) / (square * angle)
        by_a, by_b = (1.0 - b * square - 2.0 * a) / square, (a - 3.0 * b) / square
    twist, arm = cross_matrix(w), cross_matrix(torque)
    across = twist @ torque
    along = by_b * (twist @ across) - by_a * across
    return np.asarray(np.outer(along, w) + a * arm - b * (cross_matrix(across) + twist @ arm))


def cross_matrix(vector: Array) -> Array:
    """[v]x: the matrix of v x."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


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
