"""Puts a first arm together: links from axes or from a model, motors that hold them, boards, a pose to wait in.
It is written with a comment on every key, in the words of `armwright arm --keys`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import tomli_w

from calib.arm_import import SerialArm, arm_links, friction_effects
from calib.arrays import Array
from control.dynamics.dynamics import Dynamics
from control.kinematics.chain import link_transforms
from control.kinematics.kinematics import Corners, ForwardKinematics
from control.model.arm import Arm, Board, CanBus, Drive, DrivePid, Effect, EncoderBoardPort, Home, Limits, Link, Rest, Tool
from control.model.board_kinds import KINDS
from control.model.reader import keys_of
from control.model.reference import texts_of
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
        answers.name, links, gravity_m_s2=serial.gravity_m_s2, dh_convention=answers.convention, effects=friction_effects(serial)
    )
    limits, floor_notes = _limits(serial)
    rest = rest_pose(bare, ranges, limits.floor_z_m)
    limits, more = _floor_below(bare, rest, limits)
    needed = loads(bare, ranges)
    arm = dataclasses.replace(bare, drives=drives(serial.joints, needed, answers.parts, rest), rest=Rest(rest), limits=limits)
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
            (joint.where, "" if mass is None else mass.where) for joint, mass in zip(serial.joints, serial.masses, strict=True)
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
        if drive.joint_upper_rad - drive.joint_lower_rad < min(joint.upper_rad - joint.lower_rad, 2.0 * WITHOUT_LIMIT_rad) - 1e-9
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


VALUE_WIDTH = 38
ON_REFERENCE = {"encoder_board", "encoder_channel", "motor_node", "board_holds"}
ON_BOUGHT = {"board", "board_channel"}
PLACEHOLDERS = "Placeholders where you did not say otherwise: compare every value with your parts."
SECTIONS = {
    "link": "links: DH rows from base to tip, and what each weighs",
    "drive": f"motors, gears, encoders and limits, one per joint. {PLACEHOLDERS}",
    "home": "home switch; `armwright bringup` measures where it changes and where the index is",
    "board": "bought boards (docs/boards.md)",
    "encoder_board": "encoder boards: three channels each, joints in order",
    "can": "bus of the motor boards; node j of the reference boards drives joint j",
    "rest": "a pose to wait in",
    "limits": "limits that the loop enforces; more of them: armwright arm --keys limits",
    "effect": "effects of the model (docs/formats.md#effects)",
}
LATER = """# Not here yet: [table] with its cavities (session, calibrate without a camera), [camera] (verify), [drive.pid] (gains
# from `armwright tune`; until then from the model). What the arm can do: armwright arm FILE. To try: armwright mock --arm FILE
"""


def commented_text(new: NewArm, origin: str) -> str:
    """The arm as a commented arm.toml; `origin` says what it was made from."""
    arm = new.arm
    lines = [f"# Arm {arm.name}, {origin}. SI units, radians; every key: armwright arm --keys."]
    lines += [f"# {_plain(note)}." for note in new.notes]
    lines += _keys(
        arm, Arm, ("name", *(key for key in ("as_given", "placeholders") if getattr(arm, key)), "gravity_m_s2", "dh_convention")
    )
    lines += _links(arm)
    if arm.tool != Tool():
        lines += ["", "[tool]", *_keys(arm.tool, Tool, ("position_m",))]
    lines += _drives(arm)
    for number, board in enumerate(arm.boards):
        lines += ["", *([f"# {SECTIONS['board']}"] if number == 0 else []), "[[board]]"]
        lines += _keys(board, Board, _keys_of_board(board), with_comments=number == 0)
    lines += _tables("encoder_board", EncoderBoardPort, arm.encoder_boards, ("name", "port", "baud"))
    if arm.can is not None:
        lines += _table("can", arm.can, CanBus, ("interface", "channel", "bitrate"))
    if arm.rest is not None:
        lines += _table("rest", arm.rest, Rest, ("q_rad",))
    limits: tuple[str, ...] = ("tip_speed_m_s", "floor_z_m", "floor_tolerance_m", "base_radius_m", "payload_limit_kg")
    limits = (*limits, "stale_s") if arm.boards else limits
    lines += _table("limits", arm.limits, Limits, limits)
    lines += _tables("effect", Effect, arm.effects, ("effect", "joint", "parameters"))
    return "\n".join([*lines, "", LATER])


def _links(arm: Arm) -> list[str]:
    lines, joint = ["", f"# {SECTIONS['link']}"], 0
    for number, link in enumerate(arm.links):
        joint += link.joint == "revolute"
        what = f"# joint {joint}" if link.joint == "revolute" else "# fixed"
        lines += ["", f"{'[[link]]':<{VALUE_WIDTH}}  {what}"]
        lines += _keys(link, Link, tuple(key for key in keys_of(Link) if getattr(link, key) != ""), with_comments=number == 0)
    return lines


def _drives(arm: Arm) -> list[str]:
    lines = ["", f"# {SECTIONS['drive']}"]
    for number, drive in enumerate(arm.drives):
        lines += ["", "[[drive]]", *_keys(drive, Drive, _keys_of_drive(drive), with_comments=number == 0)]
        if drive.board:
            lines += ["", "[drive.pid]", *_keys(drive.pid, DrivePid, ("mode",), with_comments=number == 0)]
        if drive.home is not None:
            lines += ["", *([f"# {SECTIONS['home']}"] if number == 0 else []), "[drive.home]"]
            keys = tuple(key for key in keys_of(Home) if key != "switch")
            lines += _keys(drive.home, Home, keys, with_comments=number == 0)
    return lines


def _keys_of_drive(drive: Drive) -> list[str]:
    """Those of its own table that its board leaves open."""
    left_out = {"pid", "home", "limit_switches"} | (ON_REFERENCE if drive.board else ON_BOUGHT)
    left_out |= set() if drive.zero_count else {"zero_count"}
    left_out |= set() if drive.servo else {"servo"}
    left_out |= {"encoder_on"} if drive.servo else set()
    left_out |= set() if drive.motor_counts_per_rev else {"motor_counts_per_rev"}
    left_out |= set() if drive.encoder_ratio != 1.0 else {"encoder_ratio"}
    left_out |= set() if drive.servos > 1 else {"servos"}
    return [key for key in keys_of(Drive) if key not in left_out]


def _keys_of_board(board: Board) -> list[str]:
    """Those that mean something for its kind."""
    kind = KINDS[board.kind]
    where = ["port", "baud"] if kind.line == "serial" else []
    return ["name", "kind", "address", *where, *(["absolute", "absolute_turns"] if kind.may_be_absolute else [])]


def _tables(name: str, kind: type[Any], items: Sequence[object], keys: tuple[str, ...]) -> list[str]:
    lines = ["", f"# {SECTIONS[name]}"] if items else []
    for number, item in enumerate(items):
        lines += [*([""] if number else []), f"[[{name}]]"]
        lines += _keys(item, kind, keys, with_comments=number == 0)
    return lines


def _table(name: str, item: object, kind: type[Any], keys: tuple[str, ...]) -> list[str]:
    return ["", f"# {SECTIONS[name]}", f"[{name}]", *_keys(item, kind, keys)]


def _keys(item: object, kind: type[Any], keys: Sequence[str], with_comments: bool = True) -> list[str]:
    """A line for each key that has a value."""
    texts, fields = texts_of(kind), keys_of(kind)
    lines = []
    for key in keys:
        value = getattr(item, fields[key].name)
        if value is None or (isinstance(value, float) and math.isinf(value)):
            continue
        line = f"{key} = {_toml(value)}"
        comment = texts[key].partition(";")[0]
        lines.append(f"{line:<{VALUE_WIDTH}}  # {comment}" if with_comments and comment else line)
    return lines


def _toml(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {_toml(one)}' for key, one in value.items())} }}"
    return tomli_w.dumps({"x": value}).removeprefix("x = ").rstrip("\n")


def _plain(text: str) -> str:
    """One line without control characters, fit for a comment."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())
