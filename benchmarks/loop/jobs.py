"""Setup of the measurements: the arm, its scenario, and the circle."""

from dataclasses import replace
from typing import Literal

import msgspec

from control.model.arm import Arm
from control.model.description import load_arm
from control.model.table import table_of
from control.motion.plan import PlannedPath, plan_path
from control.motion.waypoints import Waypoints, circle
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


def circle_path(arm: Arm, turns: int = 1) -> PlannedPath:
    """Around the calibration table's circle of 0.09 m, `turns` times without a stop, planned for `arm`."""
    once = circle(table_of(arm), height_m=HEIGHT_m)
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
