"""Several arms that stand together: a cell.toml names their files, where each base stands, and the links they share.

The frame of the cell is the one in which `origin_m` and `orientation` are given. `armwright arm --keys cell` prints the keys.
"""

import dataclasses
import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tomli_w

from control.errors import ArmError, ArmFileError
from control.files import parsed_toml, read_text, write_whole
from control.model import rules
from control.model.arm import Arm, Camera, CanBus
from control.model.board_kinds import KINDS, bus_conflict
from control.model.description import load_arm, save_arm, syntax_error
from control.model.end_effector import Vector3
from control.model.reader import Rejected, key_lines, nearest_line, read_table

SUPPLIED = Path(__file__).parents[1] / "cells"
UNIT_TOLERANCE = 2e-3  # of a quaternion's length: three decimals in a file
GRAVITY_TOLERANCE_m_s2 = 0.1  # between two arms' gravity in the frame of the cell: half a degree of tilt
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class ArmEntry:
    """An arm of the cell: its file, its base, and what differs from the file beside another arm."""

    file: Annotated[str, "an arm.toml, relative to this file, or the name of a supplied arm"]
    name: Annotated[str, rules.NAME, "in commands, sockets and recordings; absent: that of its file"] = ""
    origin_m: Annotated[Vector3, rules.POSITION, "of the arm's base frame, in the frame of the cell"] = (0.0, 0.0, 0.0)
    orientation: Annotated[Quaternion, "qw, qx, qy, qz of the base frame in the frame of the cell"] = (1.0, 0.0, 0.0, 0.0)
    encoder_ports: Annotated[tuple[str, ...], "instead of the ports in its file, in their order"] = ()
    board_ports: Annotated[
        tuple[str, ...], "instead of those of its [[board]]s, one per serial port, in the order of the file"
    ] = ()
    motor_nodes: Annotated[
        tuple[Annotated[int, rules.NODE], ...], "instead of those in its file, one per drive; for a shared bus"
    ] = ()
    camera_port: Annotated[Annotated[int, rules.UDP_PORT] | None, "instead of the one in its file"] = None


@dataclass(frozen=True, slots=True)
class CellFile:
    """A cell.toml: several arms under one runtime. Without [can] each arm has the bus of its own file."""

    name: Annotated[str, rules.NAME, "of the cell"]
    entries: tuple[ArmEntry, ...] = field(metadata={"key": "arm"})
    clearance_m: Annotated[float, rules.CLEARANCE, rules.NOT_NEGATIVE, "kept between two arms, beyond their radii"] = 0.02
    tool_length_m: Annotated[
        float, rules.CLEARANCE, rules.NOT_NEGATIVE, "of each arm's tool, up to the tip; two tools may touch"
    ] = 0.0
    can: CanBus | None = None


@dataclass(frozen=True, slots=True)
class Placed:
    """An arm and the pose of its base frame in the frame of the cell: origin, and rows of the rotation matrix."""

    arm: Arm
    origin_m: Vector3 = (0.0, 0.0, 0.0)
    orientation: Quaternion = (1.0, 0.0, 0.0, 0.0)

    @property
    def name(self) -> str:
        """The arm's name."""
        return self.arm.name

    @property
    def rotation(self) -> tuple[Vector3, Vector3, Vector3]:
        """Rows of the matrix that turns vectors of the base frame into the frame of the cell."""
        w, x, y, z = self.orientation
        return (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )

    def in_cell(self, point_m: Sequence[float]) -> Vector3:
        """A point of the base frame, in the frame of the cell."""
        x, y, z = point_m
        a, b, c = (o + r[0] * x + r[1] * y + r[2] * z for o, r in zip(self.origin_m, self.rotation, strict=True))
        return a, b, c

    def in_base(self, point_m: Sequence[float]) -> Vector3:
        """A point of the cell, in the arm's base frame."""
        x, y, z = (p - o for p, o in zip(point_m, self.origin_m, strict=True))
        a, b, c = (r[0] * x + r[1] * y + r[2] * z for r in zip(*self.rotation, strict=True))
        return a, b, c

    def beside_tip(self, leader: "Placed", tip_m: Sequence[float], offsets_m: Sequence[Sequence[float]]) -> tuple[Vector3, ...]:
        """Offsets from another arm's tip, along the axes of the cell, as points of this arm's base frame.

        `tip_m`: that tip in the other arm's own base frame.
        """
        x, y, z = leader.in_cell(tip_m)
        return tuple(self.in_base((x + u, y + v, z + w)) for u, v, w in offsets_m)


@dataclass(frozen=True, slots=True)
class Cell:
    """Arms that one runtime controls.

    `clearance_m` is kept between two arms, beyond their radii. The last `tool_length_m` of each arm, up to its tip, may come
    near the same part of another arm.
    """

    name: str
    arms: tuple[Placed, ...]
    clearance_m: float = 0.02
    tool_length_m: float = 0.0
    path: Path | None = field(default=None, compare=False)

    @property
    def names(self) -> tuple[str, ...]:
        """The arms' names."""
        return tuple(placed.name for placed in self.arms)

    def placed(self, name: str) -> Placed:
        """The arm of that name. ArmError lists the names."""
        for placed in self.arms:
            if placed.name == name:
                return placed
        raise ArmError(f"cell {self.name}: no arm {name!r}: expected one of {', '.join(self.names)}")

    def with_arms(self, arms: Sequence[Arm]) -> "Cell":
        """The same cell with other descriptions of its arms, in the same order."""
        placed = (dataclasses.replace(p, arm=arm) for p, arm in zip(self.arms, arms, strict=True))
        return dataclasses.replace(self, arms=tuple(placed))


def cell_of_one(arm: Arm) -> Cell:
    """A single arm at the origin of its own cell."""
    return Cell(arm.name, (Placed(arm),), path=arm.path)


def load_cell(path_or_name: str | Path) -> Cell:
    """Load a cell.toml, or a supplied cell by its name ("pair"). ArmFileError names file, line and key."""
    path = Path(path_or_name)
    if path.suffix != ".toml" and not path.exists():
        if str(path_or_name) not in cell_names():
            names = " or ".join(f'"{name}"' for name in cell_names())
            raise ArmFileError(str(path_or_name), None, "", f"a path to a cell.toml, or {names}", "an unknown name")
        path = SUPPLIED / f"{path_or_name}.toml"
    try:
        return _parsed(read_text(path), path)
    except UnicodeDecodeError as error:
        raise ArmFileError(path, None, "", "UTF-8 text", f"an invalid byte at {error.start}") from None
    except OSError as error:
        raise ArmFileError(path, None, "", "a readable file", error.strerror or str(error)) from None


def cell_names() -> tuple[str, ...]:
    """The names of the supplied cells."""
    return tuple(sorted(file.stem for file in SUPPLIED.glob("*.toml")))


def save_cell(cell: Cell, folder: Path) -> Path:
    """Write the cell and its arms as new files of a folder; returns the cell.toml. Its arms' files are then complete."""
    entries = []
    for placed in cell.arms:
        save_arm(placed.arm, folder / f"{placed.name}.toml")
        entries.append(
            {"file": f"{placed.name}.toml", "origin_m": list(placed.origin_m), "orientation": list(placed.orientation)}
        )
    table = {"name": cell.name, "clearance_m": cell.clearance_m, "tool_length_m": cell.tool_length_m, "arm": entries}
    file = folder / f"{cell.name}.cell.toml"
    write_whole(file, tomli_w.dumps(table), is_new=True)
    return file


def _parsed(text: str, path: Path) -> Cell:
    try:
        keys = parsed_toml(text)
        if "link" in keys:
            raise ArmFileError(path, None, "", "the arms of a cell", "an arm.toml", "give it with --arm")
        table = read_table(CellFile, keys)
        cell = Cell(
            table.name,
            tuple(_placed(entry, index, table.can, path) for index, entry in enumerate(table.entries)),
            table.clearance_m,
            table.tool_length_m,
            path,
        )
        _check(cell)
    except tomllib.TOMLDecodeError as error:
        raise syntax_error(error, text, path) from None
    except Rejected as error:
        line = nearest_line(key_lines(text), error.path)
        key = ".".join(str(part + 1) if isinstance(part, int) else part for part in error.path)
        raise ArmFileError(path, line, key, error.expected, error.got, error.hint) from None
    return cell


def _placed(entry: ArmEntry, index: int, can: CanBus | None, cell_file: Path) -> Placed:
    arm = load_arm(_beside(entry.file, cell_file))
    length = math.hypot(*entry.orientation)
    if not abs(length - 1.0) <= UNIT_TOLERANCE:
        expected = f"a unit quaternion qw, qx, qy, qz (length 1 within {UNIT_TOLERANCE:g})"
        raise Rejected(("arm", index, "orientation"), expected, f"one of length {length:.4g}")
    if entry.motor_nodes:
        if len(entry.motor_nodes) != len(arm.drives):
            raise Rejected(("arm", index, "motor_nodes"), f"{len(arm.drives)} nodes, one per drive", str(len(entry.motor_nodes)))
        drives = zip(arm.drives, entry.motor_nodes, strict=True)
        arm = dataclasses.replace(arm, drives=tuple(dataclasses.replace(drive, motor_node=node) for drive, node in drives))
    if entry.encoder_ports:
        if len(entry.encoder_ports) != len(arm.encoder_boards):
            expected = f"{len(arm.encoder_boards)} ports, one an [[encoder_board]] of {arm.path}"
            raise Rejected(("arm", index, "encoder_ports"), expected, str(len(entry.encoder_ports)))
        boards = zip(arm.encoder_boards, entry.encoder_ports, strict=True)
        arm = dataclasses.replace(arm, encoder_boards=tuple(dataclasses.replace(board, port=port) for board, port in boards))
    if entry.board_ports:
        ports = _serial_ports(arm)
        if len(entry.board_ports) != len(ports):
            expected = f"{len(ports)} ports, one for each of {', '.join(ports) or 'none'} in {arm.path}"
            raise Rejected(("arm", index, "board_ports"), expected, str(len(entry.board_ports)))
        port_of = dict(zip(["", *ports], ["", *entry.board_ports], strict=True))
        arm = dataclasses.replace(arm, boards=tuple(dataclasses.replace(board, port=port_of[board.port]) for board in arm.boards))
    if entry.camera_port is not None:
        camera = (arm.camera or Camera()).with_port(entry.camera_port)
        arm = dataclasses.replace(arm, camera=camera)
    arm = dataclasses.replace(arm, name=entry.name or arm.name, can=can or arm.can)
    w, x, y, z = (value / length for value in entry.orientation)
    return Placed(arm, entry.origin_m, (w, x, y, z))


def _serial_ports(arm: Arm) -> list[str]:
    """Those that its bought boards are on; boards may share one."""
    return list(dict.fromkeys(board.port for board in arm.boards if board.port))


def _beside(file: str, cell_file: Path) -> str:
    """A path relative to the cell's file; the name of a supplied arm stays as it is."""
    return str(cell_file.parent / file) if Path(file).suffix == ".toml" else file


def _check(cell: Cell) -> None:
    """Raise Rejected for what two arms cannot both have."""
    if not cell.arms:
        raise Rejected(("arm",), "at least one [[arm]]", "none")
    owner: dict[object, str] = {}
    kinds_on: dict[tuple[str, str], set[str]] = {}
    for index, placed in enumerate(cell.arms):
        for key, what, claim in _claims(placed):
            if claim in owner:
                raise Rejected(("arm", index, key), f"{what} that no other arm of the cell has", f"that of arm {owner[claim]!r}")
            owner[claim] = placed.name
        if (can := placed.arm.can) is not None:
            kinds = kinds_on.setdefault((can.interface, can.channel), set())
            kinds |= {board.kind for board in placed.arm.boards if KINDS[board.kind].line == "can"}
            kinds |= {"" for drive in placed.arm.drives if not drive.board}
            if (conflict := bus_conflict(kinds)) is not None:
                raise Rejected(("arm", index, "file"), conflict, f"both on {can.interface}:{can.channel}")
        first, here = _gravity(cell.arms[0]), _gravity(placed)
        if max(abs(a - b) for a, b in zip(first, here, strict=True)) > GRAVITY_TOLERANCE_m_s2:
            raise Rejected(
                ("arm", index, "orientation"),
                f"gravity as of arm {cell.arms[0].name!r} in the frame of the cell, {_rounded(first)} m/s^2",
                f"{_rounded(here)}",
                f"gravity_m_s2 of {placed.arm.path} is in the arm's base frame",
            )


def _claims(placed: Placed) -> list[tuple[str, str, object]]:
    """What an arm has to itself: key of the cell's file, in words, and what it is."""
    arm, can = placed.arm, placed.arm.can
    claims: list[tuple[str, str, object]] = [("name", "a name", ("name", arm.name))]
    claims += [("encoder_ports", "a port", ("port", board.port)) for board in arm.encoder_boards]
    claims += [("board_ports", f"a port for its [[board]]s (here {port})", ("port", port)) for port in _serial_ports(arm)]
    if can is not None:
        bus = (can.interface, can.channel)
        claims += [
            ("file", f"an address of a {board.kind} (here {board.address}) on {can.channel}", (board.kind, *bus, board.address))
            for board in arm.boards
            if KINDS[board.kind].line == "can"
        ]
        nodes = [drive.motor_node for drive in arm.drives if not drive.board]
        nodes += [arm.gripper.motor_node] if arm.gripper is not None and not arm.gripper.board else []
        claims += [("motor_nodes", f"a motor node (here {node})", ("node", *bus, node)) for node in nodes]
    if arm.camera is not None and arm.camera.listens:
        claims.append(("camera_port", "a camera port", ("camera", arm.camera.port)))
    return claims


def _gravity(placed: Placed) -> Vector3:
    """Gravity in the frame of the cell."""
    x, y, z = (sum(r * g for r, g in zip(row, placed.arm.gravity_m_s2, strict=True)) for row in placed.rotation)
    return x, y, z


def _rounded(vector: Vector3) -> list[float]:
    return [round(value, 2) for value in vector]
