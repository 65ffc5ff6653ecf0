"""Gears of an arm at rest: the torque that each transmits, and its contact flank.

A joint at rest was driven or hand-guided there. If driven, dry friction retains some of the torque
of its last motion, part of it on the link side. With gravity torque g, motor torque t and share s of the friction
on the link side, the gear transmits g + s (t - g). If hand-guided, the motor shows no friction:
where the motor's torque overcomes the friction on its own side, it pushes the gear to its flank. Elsewhere the gear lies near the
flank by which the link pushed it, but not on it, because the rotor ran on when the hand stopped.

Angles are joint angles, torques joint torques, arrays (m poses, n joints). The poses must be approached gently: an arm
that brakes harder than its link friction throws its gears onto the other flank.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from control.dynamics.dynamics import Dynamics
from control.dynamics.feedforward import (
    links_alone,
    own_payload_kg,
    torque_constant_Nm_A,
    torque_constants_Nm_A,
    with_link_inertia,
)
from control.model.arm import Arm
from control.model.effects import EFFECTS

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
LINK_SHARE_LEAST: Final = 0.02  # of a joint's dry friction: unknown, so a flank counts only if it is the same from here to 1
LED: Final = 0.3  # of a joint's friction: with less than this, the motor did not drive the joint there
FRICTION_QUANTILE: Final = 0.95  # quantile of what motors hold beyond gravity: most poses may be hand-guided
CURRENT_NOISE_A: Final = 0.02  # friction below three of these is treated as zero
GRAVITY_ERROR: Final = 0.03  # of the model's gravity torque
FRICTION_ERROR: Final = 0.005  # of a measured friction
ROUNDING_Nm: Final = 1e-6
# Of the torque at the current limit, if neither currents nor effects determine it:
ASSUMED_FRICTION: Final = 0.1
ASSUMED_LEAST: Final = 1e-3  # minimum: every gear has some


@dataclass(frozen=True, slots=True)
class RestingPose:
    """m poses at rest of an arm with n joints, all (m, n).

    gravity_Nm: what holds the links; held_Nm: what the motor holds beyond that, friction on either side of the gear;
    flank: sign of the torque from motor to joint, 0 if poses, currents and directions do not determine it; leaning: the flank
    that it lies on or near if friction alone decides, 0 if unknown; is_led: hand-guided, not driven.
    """

    gravity_Nm: Array
    held_Nm: Array
    flank: Array
    leaning: Array
    is_led: Flags


def resting(
    arm: Arm,
    q_rad: ArrayLike,
    direction: ArrayLike,
    current_A: ArrayLike | None = None,
    payload_kg: ArrayLike = 0.0,
    moving_Nm: ArrayLike = 0.0,
) -> RestingPose:
    """The state of the gears at joint angles q_rad (m, n).

    direction (m, n): sign of each joint's last motion, 0 unknown; current_A (m, n) of the motors while they hold, NaN
    unknown; payload_kg (m,), or one for all; moving_Nm (m, n): what a moving arm's links need beyond gravity. MissingModel if
    the arm's file lacks masses; of a joint without a [[drive]] nothing but its gravity is known.
    """
    q, last = np.asarray(q_rad, dtype=np.float64), np.asarray(direction, dtype=np.float64)
    gravity = gravity_Nm(arm, q, payload_kg) + np.asarray(moving_Nm, dtype=np.float64)
    current = np.full(q.shape, np.nan) if current_A is None else np.asarray(current_A, dtype=np.float64)
    held = current * known_torque_per_A(arm) - gravity
    level, is_known = friction_Nm(arm, held, gravity)
    held = np.where(is_known & (level == 0.0), 0.0, held)  # noise is no friction
    is_seen = np.isfinite(held)
    is_led = is_seen & is_known & (np.abs(held) < LED * level)
    assumed = np.where(is_seen, held, last * level)
    low, high, margin = _driven_range(gravity, held, last, level, is_known)
    is_clear = (low * high > 0.0) & (np.minimum(np.abs(low), np.abs(high)) > margin)
    driven = np.where(is_clear, np.sign(high), 0.0)
    push = gravity + assumed
    led = np.where(np.abs(push) > level, np.sign(push), 0.0)
    leaning = np.where(is_led, -last, np.where(assumed * last < 0.0, 0.0, np.sign(assumed)))
    return RestingPose(gravity, assumed, np.where(is_led, led, driven), leaning, is_led)


def gravity_Nm(arm: Arm, q_rad: ArrayLike, payload_kg: ArrayLike = 0.0) -> Array:
    """Torques (m, n) that hold the links still in poses (m, n), including the arm's effects that add mass.

    MissingModel without masses.
    """
    load_kg = np.asarray(payload_kg, dtype=np.float64) + own_payload_kg(arm)
    return Dynamics(with_link_inertia(arm)).gravities(q_rad, load_kg)


def moving_Nm(arm: Arm, q_rad: Array, speed_rad_s: Array, acceleration_rad_s2: Array, payload_kg: ArrayLike = 0.0) -> Array:
    """What the links of a moving arm need beyond gravity [N m], (m, n): what gears transmit. MissingModel without masses."""
    links = Dynamics(links_alone(arm))
    load_kg = np.asarray(payload_kg, dtype=np.float64) + own_payload_kg(arm)
    moving = links.torques(q_rad, speed_rad_s, acceleration_rad_s2, load_kg)
    return np.asarray(moving - links.gravities(q_rad, load_kg))


def torque_per_A(arm: Arm) -> Array:
    """Joint torque per ampere of each motor, (n,); MissingModel if a joint has no [[drive]]."""
    return np.array(torque_constants_Nm_A(arm))


def known_torque_per_A(arm: Arm) -> Array:
    """Joint torque per ampere of each motor, (n,), not a number for a joint without a [[drive]]."""
    per_A = np.full(arm.joint_count, np.nan)
    for drive in arm.drives:
        per_A[drive.joint - 1] = torque_constant_Nm_A(arm, drive)
    return per_A


def friction_Nm(arm: Arm, held_Nm: Array, gravity_Nm: Array | None = None) -> tuple[Array, Flags]:
    """Dry friction of each joint (n,), and whether it is known rather than assumed.

    Estimated from held_Nm (m, n), the motor torque beyond gravity_Nm (NaN unknown), else from the arm's effects. A motor that
    holds no gravity, or pushes with it, may do so by friction; if a hand holds the link, the motor may be inside
    its backlash and unloaded. Such poses say nothing about friction and are used only if there are no others.
    """
    per_A = np.nan_to_num(known_torque_per_A(arm))
    modelled = np.zeros(arm.joint_count)
    for effect in arm.effects:
        if EFFECTS[effect.effect].is_dry and effect.joint is not None:
            modelled[effect.joint - 1] += effect.parameters["torque_Nm"]
    seen = np.isfinite(held_Nm).any(axis=0)
    shown = np.zeros(arm.joint_count)
    if seen.any():
        counted = held_Nm if gravity_Nm is None else _without_unloaded(held_Nm, gravity_Nm, per_A)
        shown[seen] = np.nanquantile(np.abs(counted[:, seen]), FRICTION_QUANTILE, axis=0)
    shown[shown < 3.0 * CURRENT_NOISE_A * per_A] = 0.0
    limits_A = np.zeros(arm.joint_count)
    for drive in arm.drives:
        limits_A[drive.joint - 1] = drive.current_limit_A if np.isfinite(drive.current_limit_A) else 0.0
    assumed = ASSUMED_FRICTION * per_A * limits_A
    known = np.where(shown > 0.0, shown, modelled)
    is_known = seen | (known > 0.0)
    return np.where(is_known, known, assumed), is_known


def _without_unloaded(held: Array, gravity: Array, per_A: Array) -> Array:
    """`held` (m, n), NaN where the motor does not hold gravity; unchanged for a joint where that is so in all poses."""
    is_unloaded = (held * gravity < 0.0) & (np.abs(held) > np.abs(gravity))
    is_unloaded &= np.abs(gravity) > 3.0 * CURRENT_NOISE_A * per_A
    left = np.where(is_unloaded, np.nan, held)
    return np.where(np.isfinite(left).any(axis=0), left, held)


def _driven_range(gravity: Array, held: Array, last: Array, level: Array, is_known: Flags) -> tuple[Array, Array, Array]:
    """Lower and upper bound of a driven joint's transmitted torque, and its required distance from 0, all (m, n).

    A motor that seems to hold friction against the joint's last motion has turned back since, or the arm braked hard. Then
    friction may have either sign.
    """
    is_seen = np.isfinite(held)
    friction = np.where(is_seen, held, last * level)
    least = np.where(is_known, LINK_SHARE_LEAST, ASSUMED_LEAST) * friction
    turned_back = is_seen & (held * last < 0.0) & (np.abs(held) > LED * level)
    least = np.where(turned_back, -friction, least)
    margin = GRAVITY_ERROR * np.abs(gravity) + np.where(is_known, FRICTION_ERROR * level, 0.0) + ROUNDING_Nm
    return gravity + least, gravity + friction, margin
