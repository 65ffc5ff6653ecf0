"""Setup of the measurements: the arm, its scenario, and the circle."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Literal

import msgspec

from control.model import table as tables
from control.model.arm import Arm, Table
from control.model.description import load_arm
from control.motion.plan import PlannedPath, plan_path
from control.motion.waypoints import Waypoints
from control.server.client import ArmClient
from hil_mocks.scenario import EveryJoint, Scenario, Start, TrueDh, load_scenario

CIRCLE_SPEED_m_s = 0.15
HEIGHT_m = 0.05  # above the board, as in the demo
PidMode = Literal["voltage", "current", "position"]


def reference_arm(mode: PidMode = "voltage") -> Arm:
    """The supplied arm, with all drives in one mode; gains are derived from the model."""
    arm = load_arm("right")
    return replace(arm, drives=tuple(replace(d, pid=replace(d.pid, mode=mode)) for d in arm.drives))


def known_geometry(has_friction: bool, seed: int) -> Scenario:
    """The demo's arm as in arm.toml: no hidden DH deviations, zeros known, with its noise."""
    demo = load_scenario("demo")
    known = msgspec.structs.replace(demo, seed=seed, true_dh=TrueDh(), start=Start(homed=True))
    return known if has_friction else msgspec.structs.replace(known, effect=(), every_joint=EveryJoint())


def circle(table: Table, setup: str = "normal", height_m: float = 0.0) -> Waypoints:
    """Once around the table's circle, from cavity 1 back to it, `height_m` above the board."""
    return _above_board(table, setup, [*range(1, table.circle_points + 1), 1], height_m)


def line(table: Table, setup: str = "normal", height_m: float = 0.0) -> Waypoints:
    """Along the table's line from its first cavity to its last, `height_m` above the board."""
    first = table.circle_points + 1
    return _above_board(table, setup, range(first, first + table.line_points), height_m)


def _above_board(table: Table, setup: str, numbers: Iterable[int], height_m: float) -> Waypoints:
    cavities = [tables.board_cavities(table)[str(number)] for number in numbers]
    return Waypoints(tuple(tables.to_base(table, setup, (x, y, z + height_m)) for x, y, z in cavities), None)


def circle_path(arm: Arm, turns: int = 1) -> PlannedPath:
    """Around the calibration table's circle of 0.09 m, `turns` times without a stop, planned for `arm`."""
    once = circle(tables.table_of(arm), height_m=HEIGHT_m)
    points = once.points + turns_after(once, turns)
    return plan_path(arm, Waypoints(points, None), CIRCLE_SPEED_m_s)


def turns_after(once: Waypoints, turns: int) -> tuple[tuple[float, float, float], ...]:
    """The points of the later turns, which start where the first ended."""
    return once.points[1:] * (turns - 1)


def go_to_start(client: ArmClient, path: PlannedPath, speed: float = 1.0) -> None:
    """Enable and home the arm, and move the tip to the path's first point, at a fraction of the joints' speed."""
    client.enable()
    client.home()
    client.move_joints(path.q_start_rad, speed)
