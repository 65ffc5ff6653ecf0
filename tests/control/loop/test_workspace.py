"""Floor, table and base as the server's last guard: whatever is asked for, the plant's tip stays above the table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from control.motion.joint_limits import JointLimits
from control.motion.joint_move import JointMove
from control.motion.joint_path import JointPath
from control.motion.plan import PlannedPath, plan_path
from control.motion.setpoint import SetPoint, at_rest
from control.safety.table import Mode
from control.server.client import RequestRefused
from tests.cell import RIGHT, Cell, holding_cell, scenario

LOW = (0.6, -0.8, -0.1)  # beside the board, the tip 0.07 m above the table
TOLERANCE_m = RIGHT.limits.floor_tolerance_m
FLOORLESS = replace(RIGHT, table=None, limits=replace(RIGHT.limits, floor_z_m=-1.0))


@pytest.fixture
def low() -> Iterator[Cell]:
    with holding_cell(scenario(LOW)) as cell:
        yield cell


def lowest_tip_m(cell: Cell) -> list[float]:
    """Grows while cycles run: the true height of the tip."""
    heights: list[float] = []
    cell.watchers.append(lambda: heights.append(cell.rig.tip_m()[2]))
    return heights


def test_a_joint_move_into_the_table_is_refused_and_nothing_moves(low: Cell) -> None:
    speeds = low.true_speeds()
    with pytest.raises(RequestRefused, match="below the floor or table"):
        low.client.move_joints((0.6, -1.4, -0.6))
    low.run(0.1)
    assert low.mode is Mode.HOLDING
    assert max(speeds) < 0.05


def test_a_raw_path_into_the_table_is_refused(low: Cell) -> None:
    low.client.move_joints(LOW)  # gravity pulls a little where the drives were just switched on
    x, y, z = low.client.status()["tip_m"]
    path = plan_path(FLOORLESS, [(x, y, z), (x, y, -0.1)], 0.1, q_near_rad=LOW)
    assert "below the floor or table" in low.refusal(do="run_path", path=path.to_message())
    down = tuple(q - 0.4 for q in LOW)
    still = (0.0, 0.0, 0.0)
    joints = JointPath((0.0, 4.0), (SetPoint(LOW, still, still), SetPoint(down, still, still)))
    assert "below the floor or table" in low.refusal(do="run_joints", path=joints.to_message())
    assert low.mode is Mode.HOLDING


@pytest.mark.parametrize(
    "request_",
    [
        {"joint_speed_rad_s": [0.0, -2.0, -2.0]},
        {"joint_speed_rad_s": [0.3, -2.0, 0.0]},
        {"tip_velocity_m_s": [0.0, 0.0, -0.25]},
        {"tip_velocity_m_s": [-0.1, 0.1, -0.2]},
    ],
    ids=str,
)
def test_a_jog_comes_to_rest_above_the_floor_says_why_and_can_be_jogged_back(
    low: Cell, request_: dict[str, Any]
) -> None:
    heights, limited = lowest_tip_m(low), ""
    for _ in range(30):  # renewed all the time, at rest too
        limited = str(low.client.ask("jog", **request_)["limited"]) or limited
        low.run(0.1)
    assert "below the floor or table" in limited
    assert -TOLERANCE_m - 0.003 < min(heights) < 0.01
    low.run(0.5)
    assert low.mode is Mode.HOLDING
    assert low.faults == []
    before = low.rig.tip_m()[2]
    low.client.jog(axis="z", by_m=0.03)
    assert low.rig.tip_m()[2] == pytest.approx(before + 0.03, abs=3e-3)


def test_a_jog_step_into_the_table_does_not_get_there(low: Cell) -> None:
    heights = lowest_tip_m(low)
    assert "below the floor or table" in low.client.jog(axis="z", by_m=-0.15)
    assert "below the floor or table" in low.client.jog(joint=2, by_rad=-0.5)
    assert -TOLERANCE_m - 0.003 < min(heights)
    assert low.mode is Mode.HOLDING


def test_a_motion_that_no_check_saw_is_stopped_at_the_floor(low: Cell) -> None:
    """As a plan that dips between two checked poses would be."""
    heights = lowest_tip_m(low)
    motion = JointMove(LOW, (0.6, -1.4, -0.6), JointLimits.of(RIGHT).scaled(0.15))
    low.client.move_joints(LOW)
    low.runtime.start(motion)
    low.until_fault(5.0)
    assert low.faults == [("workspace", "motion")]
    low.run(1.0)
    assert min(heights) > -TOLERANCE_m - 0.02
    low.client.acknowledge()
    low.client.move_joints(LOW)


def test_an_arm_without_a_stated_floor_stands_on_its_own_base_plane() -> None:
    assert RIGHT.limits.floor_z_m == 0.0
    assert type(RIGHT.limits)().floor_z_m == 0.0


def test_a_guard_costs_a_small_part_of_a_cycle(low: Cell) -> None:
    import time

    guard, here = low.runtime.parts.tool.guard, at_rest(LOW)
    begun_s = time.process_time()
    for _ in range(2000):
        guard.objection(here.q_rad, here.q_rad)
    assert (time.process_time() - begun_s) / 2000 < 1e-4


def test_a_path_that_was_planned_for_this_arm_touches_the_board(low: Cell) -> None:
    x, y = RIGHT.table.origin_m[:2]
    path: PlannedPath = plan_path(RIGHT, [(x, y, 0.05), (x, y, 0.0), (x, y, 0.05)], 0.05, q_near_rad=LOW)
    low.client.move_joints(path.q_start_rad)
    low.client.run_path(path.to_message())
    assert low.faults == []
