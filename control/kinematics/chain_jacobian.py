"""The derivative of the tip by every DH parameter, for many poses at once.

Geometric form (Siciliano et al., Robotics: Modelling, Planning and Control, 3.1): a move along an axis e changes
the tip by e, a turn about e through the point o by e x (tip - o). In both conventions a link's d and theta act
along and about one z axis, L and alpha along and about one x axis.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from control.kinematics.chain import Array, steps
from control.model.arm import Convention

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


def tip_slopes(
    dh: Array, q: Array, joints: Sequence[bool], convention: Convention, tool_m: Sequence[float]
) -> TipSlopes:
    """Return the tips of poses (m, n) and their derivatives by every DH parameter and by the tool."""
    slopes = np.empty((len(dh), 2, 2, 3, len(q)))  # link, axis z or x, move or turn: the order of a DH row
    axes = slopes[:, :, MOVE]
    arms = np.empty_like(axes)
    tip, frame = _walk(dh, q, joints, convention, tool_m, axes, arms)
    np.subtract(tip, arms, out=arms)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        turn = slopes[:, :, TURN, i]
        np.multiply(axes[:, :, j], arms[:, :, k], out=turn)
        turn -= axes[:, :, k] * arms[:, :, j]
    jacobian = slopes.reshape(4 * len(dh), 3, len(q))
    return TipSlopes(np.ascontiguousarray(tip.T), jacobian.transpose(2, 1, 0), frame.transpose(2, 1, 0))


def _walk(
    dh: Array,
    q: Array,
    joints: Sequence[bool],
    convention: Convention,
    tool_m: Sequence[float],
    axes: Array,
    origins: Array,
) -> tuple[Array, Array]:
    """Fill in each link's z and x axis and a point on each (links, 2, 3, m).

    Return the tip (3, m) and the axes of the last frame (axis, 3, m).

    The axes of a step are those of the frame that it starts from; a turn about an axis leaves it in place.
    """
    angles = q.T + dh[np.asarray(joints), 1, None]
    cosines, sines = np.cos(angles), np.sin(angles)
    frame = np.zeros((3, 3, len(q)))  # the moving frame's axes in the base frame
    frame[0, 0] = frame[1, 1] = frame[2, 2] = 1.0
    origin = np.zeros((3, len(q)))
    for step in steps(dh.tolist(), joints, convention):
        along, kind = (2, Z) if step.axis == "z" else (0, X)
        axes[step.link, kind] = frame[along]
        if step.move != 0.0:
            origin = origin + step.move * frame[along]
        origins[step.link, kind] = origin
        if step.joint is not None:
            _turn(frame, along, cosines[step.joint], sines[step.joint])
        elif step.turn != 0.0:
            _turn(frame, along, math.cos(step.turn), math.sin(step.turn))
    for length, axis in zip(tool_m, frame, strict=True):
        if length != 0.0:
            origin = origin + length * axis
    return origin, frame


def _turn(frame: Array, along: int, c: Array | float, s: Array | float) -> None:
    """Turn the moving frame about its own axis `along`, x or z, in place."""
    pair = frame[1:] if along == 0 else frame[:2]
    by_cosine, by_sine = c * pair, s * pair
    np.add(by_cosine[0], by_sine[1], out=pair[0])
    np.subtract(by_cosine[1], by_sine[0], out=pair[1])
