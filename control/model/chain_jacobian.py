"""The derivative of the tip by every DH parameter, for many poses at once.

Geometric form (Siciliano et al., Robotics: Modelling, Planning and Control, 3.1): a move along an axis e changes
the tip by e, a turn about e through the point o by e x (tip - o). In both conventions a link's d and theta act
along and about one z axis, L and alpha along and about one x axis.
"""

from collections.abc import Sequence

import numpy as np

from control.model.arm import Convention
from control.model.chain import Array, steps

D, THETA, L, ALPHA = range(4)


def tips_and_dh_jacobian(
    dh: Array, q: Array, joints: Sequence[bool], convention: Convention, tool_m: Sequence[float]
) -> tuple[Array, Array]:
    """Return tips (m, 3) and d tip / d dh.ravel() (m, 3, 4 links) [m/m, m/rad] of poses (m, n), base frame."""
    axes, origins, tip = _axes_origins_tip(dh, q, joints, convention, tool_m)
    arm = tip - origins
    jacobian = np.empty((len(dh), 4, 3, len(q)))
    jacobian[:, D] = axes[:, 0]
    jacobian[:, L] = axes[:, 1]
    for parameter, kind in ((THETA, 0), (ALPHA, 1)):
        e, r = axes[:, kind], arm[:, kind]
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            np.multiply(e[:, j], r[:, k], out=jacobian[:, parameter, i])
            jacobian[:, parameter, i] -= e[:, k] * r[:, j]
    return np.ascontiguousarray(tip.T), np.ascontiguousarray(jacobian.reshape(4 * len(dh), 3, -1).T)


def _axes_origins_tip(
    dh: Array, q: Array, joints: Sequence[bool], convention: Convention, tool_m: Sequence[float]
) -> tuple[Array, Array, Array]:
    """Return of each link its z and x axis and a point on each (links, 2, 3, m), and the tip (3, m).

    The axes of a step are those of the frame that it starts from; a turn about an axis leaves it in place.
    """
    count = len(q)
    axes = np.empty((len(dh), 2, 3, count))
    origins = np.empty_like(axes)
    frame = np.zeros((3, 3, count))  # frame[i]: the moving frame's axis i in the base frame
    frame[0, 0] = frame[1, 1] = frame[2, 2] = 1.0
    origin = np.zeros((3, count))
    for step in steps(dh.tolist(), joints, convention):
        along, kind = (2, 0) if step.axis == "z" else (0, 1)
        axis = frame[along]
        axes[step.link, kind] = axis
        if step.move != 0.0:
            origin = origin + step.move * axis
        origins[step.link, kind] = origin
        turn = step.turn if step.joint is None else q[:, step.joint] + step.turn
        _turn(frame, along, turn)
    tip = origin + tool_m[0] * frame[0] + tool_m[1] * frame[1] + tool_m[2] * frame[2]
    return axes, origins, tip


def _turn(frame: Array, along: int, turn: Array | float) -> None:
    """Turn the moving frame about its own axis `along`, in place."""
    if isinstance(turn, float) and turn == 0.0:
        return
    i, j = (along + 1) % 3, (along + 2) % 3
    c, s = np.cos(turn), np.sin(turn)
    turned = c * frame[i] + s * frame[j]
    frame[j] = c * frame[j] - s * frame[i]
    frame[i] = turned
