"""Forward kinematics of a DH chain: one textbook function, and its batch form with derivatives.

A link frame follows Tz(d) Rz(theta) Tx(L) Rx(alpha) ("standard"; SpringerPlus 5:1771, appendix) or
Rx(alpha) Tx(L) Rz(theta) Tz(d) ("modified", Craig). Either is a sequence of moves along and turns about the x
and z of the moving frame, and the functions here use only that sequence.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from control.errors import BadTarget
from control.kinematics.tracing import Scalar, Symbol, cos, sin
from control.model.arm import Convention

Array = NDArray[np.float64]
Row = Sequence[Scalar]  # d, theta, L, alpha of one link


class ChainStep(NamedTuple):
    """One step of the chain: a move along and a turn about the x or the z of the moving frame.

    `turn` is the constant part of the angle, `joint` (0-based) the joint that adds to it, `link` its row.
    """

    axis: Literal["x", "z"]
    move: Scalar
    turn: Scalar
    joint: int | None
    link: int


def steps(dh: Sequence[Row], joints: Sequence[bool], convention: Convention) -> list[ChainStep]:
    """Return the chain as steps from the base to the last frame."""
    result = []
    joint = 0
    for link, ((d, theta, length, alpha), turns) in enumerate(zip(dh, joints, strict=True)):
        along_z = ChainStep("z", d, theta, joint if turns else None, link)
        along_x = ChainStep("x", length, alpha, None, link)
        result += [along_z, along_x] if convention == "standard" else [along_x, along_z]
        joint += turns
    return result


def tip(chain: Sequence[ChainStep], q: Sequence[Scalar], tool_m: Sequence[Scalar]) -> tuple[Scalar, ...]:
    """Return the tip in the base frame, from the last frame inwards.

    Turns about parallel axes (every step between them an x-step without a turn) are summed before any sine is
    taken: R(a) (L + R(b) v) = R(a) L + R(a + b) v costs one rotation less for each of them.
    """
    x, y, z = tool_m
    for group in reversed(list(_parallel_groups(chain))):
        x, y, z = _through_group(group, q, (x, y, z))
    return x, y, z


def _parallel_groups(chain: Sequence[ChainStep]) -> Iterator[list[ChainStep]]:
    """Split the chain before each x-step that turns the axis."""
    group: list[ChainStep] = []
    for step in chain:
        if step.axis == "x" and not _is_nothing(step.turn):
            yield group
            yield [step]
            group = []
        else:
            group.append(step)
    yield group


def _through_group(group: Sequence[ChainStep], q: Sequence[Scalar], v: tuple[Scalar, ...]) -> tuple[Scalar, ...]:
    x, y, z = v
    if len(group) == 1 and group[0].axis == "x":
        c, s = cos(group[0].turn), sin(group[0].turn)
        return x + group[0].move, c * y - s * z, s * y + c * z
    constant: Scalar = 0.0
    moving: Scalar = 0.0
    arms: list[tuple[Scalar, Scalar, Scalar]] = []  # length and its direction's angle, moving and constant
    for step in group:
        if step.axis == "x":
            arms.append((step.move, moving, constant))
        else:
            z = z + step.move
            constant = constant + step.turn
            moving = moving if step.joint is None else moving + q[step.joint]
    c, s = cos(moving + constant), sin(moving + constant)
    x, y = c * x - s * y, s * x + c * y
    for length, angle, offset in reversed(arms):
        if not _is_nothing(length):
            x, y = x + length * cos(angle + offset), y + length * sin(angle + offset)
    return x, y, z


def _is_nothing(value: Any) -> bool:
    return not isinstance(value, Symbol | np.ndarray) and value == 0.0


def checked_poses(q: ArrayLike, joint_count: int) -> Array:
    """Return poses as (m, n); BadTarget if the shape is wrong or a value is not finite."""
    poses = np.asarray(q, dtype=np.float64)
    if poses.ndim != 2 or poses.shape[1] != joint_count:
        raise BadTarget(f"joint angles: expected an array (m, {joint_count}), got {poses.shape}")
    if not np.isfinite(poses).all():
        row = int(np.flatnonzero(~np.isfinite(poses).all(axis=1))[0])
        raise BadTarget(f"joint angles: expected finite numbers, got {poses[row]} in row {row + 1}")
    return poses


def tips(dh: Array, q: Array, joints: Sequence[bool], convention: Convention, tool_m: Sequence[float]) -> Array:
    """Return the tips (m, 3) in the base frame of poses (m, n), for any DH table (links, 4)."""
    chain = steps(dh.tolist(), joints, convention)
    x, y, z = tip(chain, list(q.T), [float(a) for a in tool_m])
    result = np.empty((len(q), 3))
    result[:, 0], result[:, 1], result[:, 2] = x, y, z
    return result


def link_transforms(dh: Array, q: Array, joints: Sequence[bool], convention: Convention) -> Array:
    """Return base_T_link (m, links + 1, 4, 4) of poses (m, n); index 0 is the base itself."""
    frames = np.zeros((len(q), len(dh) + 1, 4, 4))
    frames[:, 0] = np.eye(4)
    for step in steps(dh.tolist(), joints, convention):
        turn = np.full(len(q), step.turn) if step.joint is None else q[:, step.joint] + step.turn
        is_second = bool(len(q)) and frames[0, step.link + 1, 3, 3] == 1.0
        before = frames[:, step.link + is_second]
        frames[:, step.link + 1] = before @ _step_matrices(step, turn)
    return frames


def _step_matrices(step: ChainStep, turn: Array) -> Array:
    matrices = np.zeros((len(turn), 4, 4))
    matrices[:, 3, 3] = 1.0
    k = 0 if step.axis == "x" else 2
    i, j = (k + 1) % 3, (k + 2) % 3
    c, s = np.cos(turn), np.sin(turn)
    matrices[:, k, k] = 1.0
    matrices[:, i, i] = matrices[:, j, j] = c
    matrices[:, i, j], matrices[:, j, i] = -s, s
    matrices[:, k, 3] = step.move
    return matrices


# The derivative of the tip by every DH parameter, for many poses at once.
#
# Geometric form (Siciliano et al., Robotics: Modelling, Planning and Control, 3.1): a move along an axis e changes
# the tip by e, a turn about e through the point o by e x (tip - o). In both conventions a link's d and theta act
# along and about one z axis, L and alpha along and about one x axis.

Z, X = 0, 1
MOVE, TURN = 0, 1


class TipSlopes(NamedTuple):
    """Tips (m, 3) of m poses and their derivatives: by dh.ravel() (m, 3, 4 links), by the tool's position (m, 3, 3).

    Base frame; [m/m] and [m/rad]. A joint's angle adds to its link's theta, so that column is d tip / d q too. The
    derivatives are views of arrays that hold each parameter's column in one piece.
    """

    tips: Array
    by_dh: Array
    by_tool: Array


def tips_and_dh_jacobian(
    dh: Array, q: Array, joints: Sequence[bool], convention: Convention, tool_m: Sequence[float]
) -> tuple[Array, Array]:
    """Return tips (m, 3) and d tip / d dh.ravel() (m, 3, 4 links) [m/m, m/rad] of poses (m, n), base frame."""
    slopes = tip_slopes(dh, q, joints, convention, tool_m)
    return slopes.tips, np.ascontiguousarray(slopes.by_dh)


def tip_slopes(dh: Array, q: Array, joints: Sequence[bool], convention: Convention, tool_m: Sequence[float]) -> TipSlopes:
    """Return the tips of poses (m, n) and their derivatives by every DH parameter and by the tool.

    The axes of a step are those of the frame that it starts from; a turn about an axis leaves it in place.
    """
    slopes = np.empty((len(dh), 2, 2, 3, len(q)))  # link, axis z or x, move or turn: the order of a DH row
    axes = slopes[:, :, MOVE]
    arms = np.empty_like(axes)  # first a point on each axis, then the way from there to the tip
    angles = q.T + dh[np.asarray(joints), 1, None]
    cosines, sines = np.cos(angles), np.sin(angles)
    frame = np.zeros((3, 3, len(q)))  # the moving frame's axes in the base frame
    frame[0, 0] = frame[1, 1] = frame[2, 2] = 1.0
    tip = np.zeros((3, len(q)))
    for step in steps(dh.tolist(), joints, convention):
        along, kind = (2, Z) if step.axis == "z" else (0, X)
        axes[step.link, kind] = frame[along]
        if step.move != 0.0:
            tip = tip + step.move * frame[along]
        arms[step.link, kind] = tip
        if step.joint is not None:
            _turn(frame, along, cosines[step.joint], sines[step.joint])
        elif step.turn != 0.0:
            _turn(frame, along, math.cos(step.turn), math.sin(step.turn))
    for length, axis in zip(tool_m, frame, strict=True):
        if length != 0.0:
            tip = tip + length * axis
    np.subtract(tip, arms, out=arms)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        turn = slopes[:, :, TURN, i]
        np.multiply(axes[:, :, j], arms[:, :, k], out=turn)
        turn -= axes[:, :, k] * arms[:, :, j]
    jacobian = slopes.reshape(4 * len(dh), 3, len(q))
    return TipSlopes(np.ascontiguousarray(tip.T), jacobian.transpose(2, 1, 0), frame.transpose(2, 1, 0))


def _turn(frame: Array, along: int, c: Array | float, s: Array | float) -> None:
    """Turn the moving frame about its own axis `along`, x or z, in place."""
    pair = frame[1:] if along == 0 else frame[:2]
    by_cosine, by_sine = c * pair, s * pair
    np.add(by_cosine[0], by_sine[1], out=pair[0])
    np.subtract(by_cosine[1], by_sine[0], out=pair[1])
