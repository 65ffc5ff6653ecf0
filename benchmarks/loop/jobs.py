"""What the arm does while it is measured: the arm, its scenario, and the way round the circle."""

from dataclasses import replace
from typing import Literal

import msgspec

from control.model.arm import Arm
from control.model.description import load_arm
from control.model.table import table_of
from control.motion.plan import PlannedPath, plan_path
from control.motion.waypoints import Waypoints, circle
from control.server.client import ArmClient
from hil_mocks.scenario import Scenario, Start, TrueDh, load_scenario

CIRCLE_SPEED_m_s = 0.15
HEIGHT_m = 0.05  # above the board, as in the demo
PidMode = Literal["voltage", "current", "position"]


def reference_arm(mode: PidMode = "voltage") -> Arm:
    """The arm that ships, with all drives in one mode; gains follow from the model."""
    arm = load_arm("right")
    return replace(arm, drives=tuple(replace(d, pid=replace(d.pid, mode=mode)) for d in arm.drives))


def known_geometry(has_friction: bool, seed: int) -> Scenario:
    """The demo's arm as arm.toml has it: no hidden DH deviations, its zeros known, its noise as it is."""
    demo = load_scenario("demo")
    effects = demo.effect if has_friction else ()
    return msgspec.structs.replace(demo, seed=seed, true_dh=TrueDh(), effect=effects, start=Start(homed=True))


def circle_path(arm: Arm, turns: int = 1) -> PlannedPath:
    """Around the calibration table's circle of 0.09 m, `turns` times without a stop, planned for `arm`."""
    once = circle(table_of(arm), height_m=HEIGHT_m)
    points = once.points + turns_after(once, turns)
    return plan_path(arm, Waypoints(points, None), CIRCLE_SPEED_m_s)


def turns_after(once: Waypoints, turns: int) -> tuple[tuple[float, float, float], ...]:
    """The points of the turns behind the first, which begin where it ended."""
    return once.points[1:] * (turns - 1)


def go_to_start(client: ArmClient, path: PlannedPath, speed: float = 1.0) -> None:
    """Drives on, zeros found or believed, the tip at the path's first point, at a fraction of the joints' speed."""
    client.enable()
    client.home()
    client.move_joints(path.q_start_rad, speed)
