"""Link flexure: displacement of the tip if a link is an elastic beam, clamped at its joint.

Euler-Bernoulli cantilever (Gere, Mechanics of Materials, deflections of cantilever beams): a force F at distance a from the
clamp of a beam of length l deflects its end by F a^2 (3 l - a) / (6 EI) and turns it by F a^2 / (2 EI); a moment M there by
M (a l - a^2 / 2) / EI and M a / EI. Loads are the weights of everything beyond the link and of the payload, at its end, and
the link's own, at its centre of mass. Only bending in both transverse directions is modelled, not torsion.

A link extends from its joint to the next, or to the tip, including fixed links in between.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arrays import Array, frozen
from control.dynamics.feedforward import own_payload_kg, with_link_inertia
from control.errors import MissingModel
from control.model.arm import Arm

FLEXURE = "link_flexure"
BEAM_LEAST_m = 0.05  # shorter links are rigid


def beams(arm: Arm) -> tuple[int, ...]:
    """Numbers (1-based) of the links that are long enough to bend."""
    frames = link_frames(ArmModel(arm), arm.dh, np.zeros((1, arm.joint_count)))
    turning = [k + 1 for k, link in enumerate(arm.links) if link.joint == "revolute"]
    return tuple(k for k in turning if np.linalg.norm(np.subtract(*_ends_m(arm, frames, k))) >= BEAM_LEAST_m)


def _next_turning(arm: Arm, link: int) -> int | None:
    """The link (1-based) that the next joint turns; None beyond the last."""
    later = (k + 1 for k, one in enumerate(arm.links) if k >= link and one.joint == "revolute")
    return next(later, None)


def _ends_m(arm: Arm, frames: LinkFrames, link: int) -> tuple[Array, Array]:
    """Clamp and end of the beam, (m, 3) each: at its joint, and at the next joint or the tip."""
    before = 0 if arm.dh_convention == "modified" else 1  # a joint is at its own frame's origin, or at the previous one
    following = _next_turning(arm, link)
    end = frames.tip_m if following is None else frames.origin_m[:, following - before]
    return frames.origin_m[:, link - before], end


class Bending(NamedTuple):
    """What a beam does per 1 / EI [1 / (N m^2)]: displacements of the tip, turns of the last link, (m, 3) each; base frame."""

    shift: Array
    turn: Array


def bending_m(arm: Arm, q_rad: Array, payload_kg: Array, link: int, accelerated: Callable[[Array], Array] | None = None) -> Array:
    """The displacements of the tip of `bending`, (m, 3) [m N m^2], at poses (m, n)."""
    return bending(arm, link_frames(ArmModel(arm), arm.dh, q_rad), payload_kg, link, accelerated).shift


def bending(
    arm: Arm, frames: LinkFrames, payload_kg: Array, link: int, accelerated: Callable[[Array], Array] | None = None
) -> Bending:
    """What happens per 1 / EI if `link` (1-based) bends.

    payload_kg (m,). `accelerated`: for time series, from the positions (m, 3) of a mass to its accelerations, whose forces also
    bend. MissingModel if the arm's file has no masses.
    """
    if not any(one.mass_kg for one in arm.links):
        raise MissingModel(f"arm {arm.name}: a link's bending needs masses (mass_kg, com_m) of the links")
    begin, end = _ends_m(arm, frames, link)
    length = np.linalg.norm(end - begin, axis=1, keepdims=True)
    along = (end - begin) / length
    shift, turn = np.zeros_like(begin), np.zeros_like(begin)

    def bend(at: Array, force_N: Array, moment_Nm: Array) -> None:
        across, moment = _across(force_N, along), _across(moment_Nm, along)
        shift[:] += across * (at**2 * (3.0 * length - at) / 6.0)
        shift[:] += cross(moment, along) * (at * length - 0.5 * at**2)
        turn[:] += cross(along, across) * (0.5 * at**2) + moment * at

    at_end_N, at_end_Nm = np.zeros_like(begin), np.zeros_like(begin)
    for is_beyond, place_m, mass_kg in _masses(arm, frames, payload_kg, link):
        pull = np.asarray(arm.gravity_m_s2) - (0.0 if accelerated is None else accelerated(place_m))
        force_N = mass_kg[:, None] * pull
        if is_beyond:  # everything beyond acts on the beam's end
            at_end_N += force_N
            at_end_Nm += cross(place_m - end, force_N)
        else:
            at = np.clip(np.sum((place_m - begin) * along, axis=1, keepdims=True), 0.0, length)
            bend(at, force_N, cross(place_m - begin - at * along, force_N))
    bend(length, at_end_N, at_end_Nm)
    return Bending(shift + cross(turn, frames.tip_m - end), turn)


def cross(a: Array, b: Array) -> Array:
    """The cross products of vectors (m, 3), without the many cases of NumPy's own, which cost ten times as much."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx), axis=1)


def _masses(arm: Arm, frames: LinkFrames, payload_kg: Array, link: int) -> Iterator[tuple[bool, Array, Array]]:
    """For each mass: whether it is beyond the link, its position (m, 3), and its mass (m,)."""
    following = _next_turning(arm, link)
    for k, body in enumerate(arm.links[link - 1 :], start=link):
        if body.mass_kg and body.com_m is not None:
            place = frames.point_m(k, np.asarray(body.com_m))
            is_beyond = following is not None and k >= following
            yield is_beyond, place, np.full(len(place), body.mass_kg)
    if payload_kg.any():
        yield True, frames.tip_m, payload_kg


def _across(vectors: Array, along: Array) -> Array:
    """The transverse component (m, 3)."""
    return np.asarray(vectors - np.sum(vectors * along, axis=1, keepdims=True) * along)


def known_bending(arm: Arm, q_rad: Array, payload_kg: Array, left_out: Collection[int | None] = ()) -> Bending | None:
    """Displacements of the tip [m] and turns of the last link [rad], (m, 3) each, by the flexures that the arm already has.

    None if it has none besides those of the links `left_out`.
    """
    known = [flexure for flexure in arm.effects if flexure.effect == FLEXURE and flexure.joint not in (None, *left_out)]
    if not known:
        return None
    arm, loads = with_link_inertia(arm), np.nan_to_num(payload_kg) + own_payload_kg(arm)
    shift, turn = np.zeros((len(q_rad), 3)), np.zeros((len(q_rad), 3))
    frames = link_frames(ArmModel(arm), arm.dh, q_rad)
    for flexure in known:
        unit_bending = bending(arm, frames, loads, flexure.joint or 1)
        shift += unit_bending.shift / flexure.parameters["EI_Nm2"]
        turn += unit_bending.turn / flexure.parameters["EI_Nm2"]
    return Bending(frozen(shift), frozen(turn))


@dataclass(frozen=True, slots=True)
class LinkFrames:
    """Frames 0 (base) to L (last link) of m poses: origins (m, L + 1, 3) and axes (m, L + 1, 3, 3; columns x, y, z).

    tip_m (m, 3). Base frame.
    """

    origin_m: Array
    axes: Array
    tip_m: Array

    def point_m(self, link: int, position_m: Array) -> Array:
        """A point (3,) of a link's frame (0: base) in the base frame, (m, 3)."""
        return np.asarray(self.origin_m[:, link] + self.axes[:, link] @ np.asarray(position_m))


def link_frames(model: ArmModel, dh: Array, q_rad: Array, tool_m: Array | None = None) -> LinkFrames:
    """Of the poses (m, n) of an arm with DH table (links, 4)."""
    m = len(q_rad)
    origin, axes = np.zeros((m, len(dh) + 1, 3)), np.zeros((m, len(dh) + 1, 3, 3))
    axes[:, 0] = np.eye(3)
    angles = iter(q_rad.T)
    for k, ((d, theta, length, alpha), turns) in enumerate(zip(dh, model.joints, strict=True)):
        about = theta + next(angles)[:, None] if turns else theta
        moves = [(2, d, about), (0, length, alpha)]
        point, turned = origin[:, k], axes[:, k]
        for axis, move, turn in moves[::-1] if model.is_modified else moves:
            point = point + move * turned[:, :, axis]
            before, after = (turned[:, :, axis - 2], turned[:, :, axis - 1])  # it turns the first towards the second
            c, s = np.cos(turn), np.sin(turn)
            turned = turned.copy()
            turned[:, :, axis - 2], turned[:, :, axis - 1] = before * c + after * s, after * c - before * s
        origin[:, k + 1], axes[:, k + 1] = point, turned
    tool = model.nominal_tool_m if tool_m is None else tool_m
    return LinkFrames(origin, axes, origin[:, -1] + axes[:, -1] @ tool)
