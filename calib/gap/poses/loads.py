"""What hangs on loads: links that bend, and what only the motors' holding currents tell (payload, masses, torque constants).

A held joint's motor carries gravity and some of the joint's friction, anywhere in its band. Friction is therefore no name here:
its size would be that of the band, not of the effect. Gravity is even in the direction of the last motion, friction odd: with
both directions the former can be told.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.link_bending import FLEXURE, beams, bending_m
from calib.arm_problem.link_frames import LinkFrames, link_frames
from calib.arrays import Array, frozen
from calib.gap.finding import EffectName
from calib.gap.poses.candidate import Candidate, inverse, only
from calib.points.points import Points
from control.dynamics.feedforward import own_payload_kg, with_link_inertia
from control.dynamics.static_pose import gravity_Nm
from control.errors import MissingModel
from control.model.arm import Arm

BENDING_1_Nm2 = 1.0 / 400.0  # a tube of 25 x 1.5 mm aluminium has some 500, a printed one some 50
PAYLOAD_kg = 0.2
MASS_kg = 0.2
CONSTANT = 0.1
NO_TORQUE_Nm = 1e-6


def stated_kg(points: Points) -> Array:
    """What the data says hangs on the tip, (m,)."""
    return np.nan_to_num(points.payload_kg)


def of_the_loads(arm: Arm, points: Points, loaded: Arm) -> tuple[Candidate, ...]:
    """All of them; none for an arm without masses. Links bend, and motors hold, under what is on the arm `loaded`."""
    try:
        gravity = gravity_Nm(loaded, points.q_rad, stated_kg(points))
    except MissingModel:
        return ()
    found = [*_bending(with_link_inertia(loaded), points)]
    if np.isfinite(points.current_A).any():
        found += [*_constants(gravity), *_masses(arm, points)]
    return tuple(found)


def _bending(arm: Arm, points: Points) -> Iterator[Candidate]:
    known = {one.joint: 1.0 / one.parameters["EI_Nm2"] for one in arm.effects if one.effect == FLEXURE}
    for link in beams(arm):
        moved = bending_m(arm, arm.dh, points.q_rad, stated_kg(points) + own_payload_kg(arm), link)
        if np.ptp(moved, axis=0).max() == 0.0:
            continue
        made = Candidate(
            EffectName(FLEXURE, link),
            frozen(np.zeros((1, *points.q_rad.shape))),
            frozen([BENDING_1_Nm2]),
            inverse("EI_Nm2"),
            is_positive=True,
            slope_m=frozen(moved[None]),
        )
        yield made.beside(np.array([known[link]])) if link in known else made


def _constants(gravity: Array) -> Iterator[Candidate]:
    """A motor that gives more or less torque per ampere: current * nominal constant = (gravity + friction) / scale."""
    m, n = gravity.shape
    for j in range(n):
        if np.ptp(gravity[:, j]) > NO_TORQUE_Nm:
            yield Candidate(
                EffectName("torque_constant", j + 1),
                frozen(np.zeros((1, m, n))),
                frozen([CONSTANT]),
                inverse("scale", beyond=1.0),
                slope_Nm=frozen((gravity * np.eye(n)[j])[None]),
            )


def _masses(arm: Arm, points: Points) -> Iterator[Candidate]:
    """A mass at the tip that nobody stated, and links that are heavier than nominal."""
    frames = link_frames(ArmModel(arm), arm.dh, points.q_rad)
    yield _mass(arm, EffectName("payload"), _torque_Nm(arm, frames, frames.tip_m, len(arm.links)), PAYLOAD_kg)
    for k, link in enumerate(arm.links, start=1):
        if link.mass_kg and link.com_m is not None:
            torque = _torque_Nm(arm, frames, frames.point_m(k, np.asarray(link.com_m)), k)
            if np.ptp(torque, axis=0).max() > NO_TORQUE_Nm:
                yield _mass(arm, EffectName("link_inertia", k), torque, MASS_kg)


def _torque_Nm(arm: Arm, frames: LinkFrames, place_m: Array, link: int) -> Array:
    """What a kilogram at a place (m, 3) of a link (1-based) asks of every joint, (m, n)."""
    torque = np.zeros((len(place_m), arm.joint_count))
    turning = [k for k, one in enumerate(arm.links, start=1) if one.joint == "revolute"]
    before = 0 if arm.dh_convention == "modified" else 1
    for j, k in enumerate(turning):
        if k <= link:
            axis, origin = frames.axes[:, k - before, :, 2], frames.origin_m[:, k - before]
            moment = np.cross(place_m - origin, np.asarray(arm.gravity_m_s2))
            torque[:, j] = -np.sum(axis * moment, axis=1)
    return torque


def _mass(arm: Arm, name: EffectName, torque_Nm: Array, size_kg: float) -> Candidate:
    """torque_Nm (m, n) per kilogram; gears that the arm's file says are soft give way to it."""
    shift = np.zeros_like(torque_Nm)
    for one in arm.effects:
        if one.effect == "joint_compliance" and one.joint is not None:
            shift[:, one.joint - 1] -= torque_Nm[:, one.joint - 1] / one.parameters["stiffness_Nm_rad"]
    return Candidate(
        name, frozen(shift[None]), frozen([size_kg]), only("mass_kg"), slope_Nm=frozen(torque_Nm[None])
    )
