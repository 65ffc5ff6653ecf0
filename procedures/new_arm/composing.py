"""Puts a first arm together: links from axes or from a model, motors that hold them, boards, a pose to wait in."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arm_import import SerialArm, arm_links, friction_effects
from calib.arrays import Array
from control.dynamics.dynamics import Dynamics
from control.kinematics.chain import link_transforms
from control.kinematics.kinematics import Corners, ForwardKinematics
from control.model.arm import Arm, CanBus, EncoderBoardPort, Limits, Rest
from control.model.board_kinds import KINDS
from procedures.arm_sheet import sheet
from procedures.new_arm.answers import Answers, ChosenParts
from procedures.new_arm.motors import SERVOS, JointLoad, WITHOUT_LIMIT_rad, drives, is_level, loads, range_of
from procedures.on_boards import on_boards, serial_lines

NO_FLOOR_z_m = -10.0  # below every arm: the lowest that arm.toml takes
BELOW_REST_m = 0.05
SLOWER = 0.95  # of the model's speed; limits are rounded down to two digits


@dataclass(frozen=True, slots=True)
class NewArm:
    """An arm, and what there is to say about it.

    places: in that model, of each joint and of the heaviest body that it carries, "" where there is none.
    """

    arm: Arm
    notes: tuple[str, ...]
    places: tuple[tuple[str, str], ...] = ()

    def place_of(self, table: str, index: int, key: str) -> str:
        """Where in the model a value of a [[link]] or [[drive]] (0-based) came from; "" if it did not."""
        if table == "drive":
            return self.places[self.arm.drives[index].joint - 1][0]
        joint = sum(link.joint == "revolute" for link in self.arm.links[: index + 1])
        if table != "link" or not 1 <= joint <= len(self.places):
            return ""
        return self.places[joint - 1][key in ("mass_kg", "com_m", "inertia_kg_m2")]


def compose(serial: SerialArm, answers: Answers) -> NewArm:
    """The arm of these axes with these parts."""
    links, notes = arm_links(serial, answers.convention)
    boards = answers.parts.boards
    ranges = [range_of(joint, kind) for joint, kind in zip(serial.joints, boards, strict=True)]
    bare = Arm(
        answers.name,
        links,
        gravity_m_s2=serial.gravity_m_s2,
        dh_convention=answers.convention,
        effects=friction_effects(serial),
    )
    limits, floor_notes = _limits(serial)
    rest = rest_pose(bare, ranges, limits.floor_z_m)
    limits, more = _floor_below(bare, rest, limits)
    needed = loads(bare, ranges)
    arm = dataclasses.replace(
        bare, drives=drives(serial.joints, needed, answers.parts, rest), rest=Rest(rest), limits=limits
    )
    arm = _wired(_with_payload_limit(arm), answers.parts)
    return NewArm(
        arm,
        (
            *serial.notes,
            *notes,
            *floor_notes,
            *more,
            *_narrowed(arm, serial),
            *_placed(arm, answers.parts),
            *_weak(arm, needed),
            *_slow(arm, serial),
            *_on(arm),
        ),
        tuple(
            (joint.where, "" if mass is None else mass.where)
            for joint, mass in zip(serial.joints, serial.masses, strict=True)
        ),
    )


def _with_payload_limit(arm: Arm) -> Arm:
    """What its motors hold in every pose, rounded down to two digits, is the most that a client may state."""
    payload = sheet(arm).payload
    if payload is None or not payload.everywhere_kg < arm.limits.payload_limit_kg:
        return arm
    held_kg = payload.everywhere_kg
    digit_kg = 10.0 ** (math.floor(math.log10(held_kg)) - 1) if held_kg > 0.0 else 1.0
    limit_kg = round(math.floor(held_kg / digit_kg) * digit_kg, 6)
    return dataclasses.replace(arm, limits=dataclasses.replace(arm.limits, payload_limit_kg=limit_kg))


def _wired(arm: Arm, parts: ChosenParts) -> Arm:
    """The arm with its boards, and where they are."""
    port_of = dict(zip(serial_lines(parts.boards), parts.ports, strict=True))
    encoders = [port for line, port in port_of.items() if line.startswith("encoder board")]
    with_lines = dataclasses.replace(
        arm,
        encoder_boards=tuple(EncoderBoardPort(f"enc{number}", port) for number, port in enumerate(encoders)),
        can=CanBus(*parts.can) if parts.can else None,
    )
    wired = on_boards(with_lines, parts.boards)
    boards = (dataclasses.replace(board, port=port_of.get(board.port, "")) for board in wired.boards)
    return dataclasses.replace(wired, boards=tuple(boards))


def _on(arm: Arm) -> list[str]:
    """What bought boards need that arm.toml cannot give them."""
    kinds = dict.fromkeys(board.kind for board in arm.boards)
    notes = [f"set up each {kind} as docs/{kind}.md says" for kind in kinds]
    notes += [
        f"{kind}: it reads no home switch, so make its position that of the joint (absolute = true)"
        for kind in kinds
        if not KINDS[kind].has_switch
    ]
    needing_fd = [kind for kind in kinds if KINDS[kind].needs_fd]
    is_shared = any(KINDS[kind].line == "can" and kind not in needing_fd for kind in kinds)
    if needing_fd and (is_shared or not all(drive.board for drive in arm.drives)):
        notes.append(f"every board on the CAN bus of a {needing_fd[0]} must know CAN FD")
    return notes


def _limits(serial: SerialArm) -> tuple[Limits, list[str]]:
    if is_level(serial.gravity_m_s2):
        return Limits(), []
    note = "gravity is not along -z of the base: no floor is watched; set [limits] floor_z_m if there is one"
    return Limits(floor_z_m=NO_FLOOR_z_m), [note]


def _floor_below(arm: Arm, rest: tuple[float, ...], limits: Limits) -> tuple[Limits, list[str]]:
    """A base link whose origin is not on the floor: the floor is then below the arm at rest."""
    lowest = min(float(corner[2, 0]) for corner in Corners(arm).batch(np.array([rest])))
    if lowest >= limits.floor_z_m:
        return limits, []
    floor = round(lowest - BELOW_REST_m, 3)
    note = f"the arm reaches below z = 0 at rest: [limits] floor_z_m = {floor:g}; measure where the floor is"
    return dataclasses.replace(limits, floor_z_m=floor), [note]


def _narrowed(arm: Arm, serial: SerialArm) -> list[str]:
    """Joints whose range is that of an encoder of one turn."""
    return [
        f"joint {drive.joint}: {drive.joint_lower_rad:.4g} to {drive.joint_upper_rad:.4g} rad, narrower than asked: its board's"
        " encoder knows its place within one turn"
        for drive, joint in zip(arm.drives, serial.joints, strict=True)
        if drive.joint_upper_rad - drive.joint_lower_rad
        < min(joint.upper_rad - joint.lower_rad, 2.0 * WITHOUT_LIMIT_rad) - 1e-9
    ]


def _placed(arm: Arm, parts: ChosenParts) -> list[str]:
    """Which servos stand in the file, and what their data sheets do not tell."""
    notes = []
    for kind in dict.fromkeys(kind for kind in parts.boards if kind in SERVOS):
        of_kind = [drive for drive, board in zip(arm.drives, parts.boards, strict=True) if board == kind]
        names = ", ".join(f"joint {drive.joint} {drive.servo}" for drive in of_kind)
        notes.append(
            f"{kind}, by the data sheets: {names}; replace them by yours. Rotor inertias are not known (armwright arm names them)"
        )
        if parts.gear_ratios is not None:
            notes.append(f"{kind}: its gear is inside, so the gears that were given are not its joints'")
    return notes


def _weak(arm: Arm, needed: tuple[JointLoad, ...]) -> list[str]:
    """Joints whose motor does not hold the arm in every pose."""
    notes = []
    for drive, load in zip(arm.drives, needed, strict=True):
        torque = drive.current_limit_A * drive.torque_constant_Nm_A * drive.gear_ratio
        if torque < load.torque_Nm:
            notes.append(
                f"joint {drive.joint}: {torque:.3g} N m at {drive.current_limit_A:.3g} A do not hold"
                f" {load.torque_Nm:.3g} N m of gravity"
            )
    return notes


def _slow(arm: Arm, serial: SerialArm) -> list[str]:
    """Joints whose chosen motor does not reach the speed that the model gives."""
    slow = [
        f"joint {drive.joint} {joint.speed_rad_s:.3g} rad/s, here {drive.joint_speed_limit_rad_s:.3g}"
        for drive, joint in zip(arm.drives, serial.joints, strict=True)
        if math.isfinite(joint.speed_rad_s) and drive.joint_speed_limit_rad_s < SLOWER * joint.speed_rad_s
    ]
    return [f"speeds that the placeholder motors do not reach: {'; '.join(slow)}"] if slow else []


# A pose to wait in: above the floor, bent, with little gravity torque.
POSES: Final = 3000
STEP_rad: Final = 0.05  # angles that a reader can set
EDGE: Final = 0.1  # share of the range kept from its ends
BENT: Final = 0.5  # of the best conditioning that is found
LOW_SHARE: Final = 0.1  # of the reach: how far above the floor every joint behind the second and the tip are


def rest_pose(arm: Arm, ranges: Sequence[tuple[float, float]], above_z_m: float) -> tuple[float, ...]:
    """Joint angles within the ranges, multiples of 0.05 rad where a range is wide enough."""
    low, high = np.array(ranges).T
    room = EDGE * (high - low)
    q = np.random.default_rng(1).uniform(low + room, high - room, (POSES, arm.joint_count))
    q[:, 0] = np.clip(0.0, low[0] + room[0], high[0] - room[0])  # forwards
    rounded = np.round(q / STEP_rad) * STEP_rad
    q = np.where((rounded > low) & (rounded < high), rounded, q)
    frames = link_transforms(arm.dh, q, arm.joints, arm.dh_convention)
    tips = ForwardKinematics(arm).tips(q)
    lowest = np.minimum(frames[:, 1 + _second(arm) :, 2, 3].min(axis=1), tips[:, 2])
    reach = float(np.linalg.norm(tips, axis=1).max())
    conditioning = _conditioning(arm, q)
    good = lowest >= min(above_z_m + LOW_SHARE * reach, float(np.quantile(lowest, 0.95)))
    good &= conditioning >= BENT * conditioning[good].max()
    effort = _effort(arm, q) + 0.02 * np.abs(q).sum(axis=1)  # of equal poses, the one nearer to zero
    chosen = int(np.argmin(np.where(good, effort, np.inf)))
    return tuple(round(float(angle), 6) + 0.0 for angle in q[chosen])


def _second(arm: Arm) -> int:
    """Index of the link that joint 2 moves, or of the only one."""
    turning = [index for index, turns in enumerate(arm.joints) if turns]
    return turning[min(1, len(turning) - 1)]


def _conditioning(arm: Arm, q: Array) -> Array:
    """Smallest singular value of the tip's Jacobian, in m: 0 stretched and in other singular poses."""
    rank = min(3, arm.joint_count)
    values = np.linalg.svd(ForwardKinematics(arm).jacobians(q), compute_uv=False)
    return np.asarray(values[:, rank - 1], dtype=np.float64)


def _effort(arm: Arm, q: Array) -> Array:
    """Gravity torques relative to the largest of each joint, summed."""
    if not any(link.mass_kg for link in arm.links):
        return np.zeros(len(q))
    torques = np.abs(Dynamics(arm).gravities(q))
    total: Array = (torques / max(float(torques.max()), 1e-9)).sum(axis=1)
    return total
