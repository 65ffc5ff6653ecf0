"""Floor, table and base as the server's last guard: whatever is asked for, the plant's tip stays above the table."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from control.errors import ArmError
from control.kinematics.inverse import InverseKinematics
from control.loop.jogging import Jogging, JointSpeeds
from control.motion.guard import Guard
from control.motion.joint_limits import JogLimits, JointLimits
from control.motion.joint_move import JointMove
from control.motion.joint_path import JointPath
from control.motion.plan import PlannedPath, plan_path
from control.motion.setpoint import SetPoint, at_rest
from control.safety.modes import Mode
from control.server.client import RequestRefused
from tests.cell import RIGHT, Cell, holding_cell, scenario
from tests.thirds import third_of

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
    third_of(  # one of joints and one of the tip
        [
            {"joint_speed_rad_s": [0.0, -2.0, -2.0]},
            {"joint_speed_rad_s": [0.3, -2.0, 0.0]},
            {"tip_velocity_m_s": [0.0, 0.0, -0.25]},
            {"tip_velocity_m_s": [-0.1, 0.1, -0.2]},
        ]
    ),
    ids=str,
)
def test_a_jog_comes_to_rest_above_the_floor_says_why_and_can_be_jogged_back(low: Cell, request_: dict[str, Any]) -> None:
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


def test_a_motion_that_begins_below_the_floor_is_refused_or_comes_to_its_end() -> None:
    """As when the floor of arm.toml was raised, or an arm has sunk: none is accepted and stopped midway."""
    raised = replace(RIGHT, table=None, limits=replace(RIGHT.limits, floor_z_m=0.3))
    source, served, refused = random.Random(4), 0, 0
    with holding_cell(scenario(LOW), believed=raised) as cell:
        guard = cell.runtime.parts.tool.guard
        for _ in range(40):
            pose = cell.runtime.set_point.q_rad
            if guard.clearance(pose).distance_m >= 0.0:
                break
            target = [q + source.uniform(-0.2, 0.2) for q in pose]
            answer = cell.channel.request({"do": "move_joints", "q_rad": target, "speed": 0.5})
            refused += not answer["ok"]
            if answer["ok"]:
                served += 1
                cell.run(answer["duration_s"] + 0.1)
                assert (cell.mode, cell.faults) == (Mode.HOLDING, [])
    assert served > 1
    assert refused > 1


def test_a_motion_that_no_check_saw_is_stopped_above_the_floor_at_full_speed(low: Cell) -> None:
    """As a plan that dips between two checked poses would be."""
    heights = lowest_tip_m(low)
    low.client.move_joints(LOW)
    low.runtime.start(JointMove(LOW, (0.6, -1.4, -0.6), JointLimits.of(RIGHT)), as_encoders=False)
    low.until_fault(5.0)
    assert low.faults == [("workspace", "motion")]
    low.run(1.0)
    assert min(heights) > -TOLERANCE_m - 0.001
    low.client.acknowledge()
    low.client.move_joints(LOW)


def test_a_motion_that_cannot_go_on_is_noticed_while_the_arm_can_still_stop_on_it(low: Cell) -> None:
    class Ending(JointMove):
        def at(self, time_s: float) -> SetPoint:
            if time_s > 0.6:
                raise ArmError("no pose there")
            return super().at(time_s)

    low.client.move_joints(LOW)
    motion = Ending(LOW, (-1.0, -0.3, 0.5), JointLimits.of(RIGHT))
    low.runtime.start(motion, as_encoders=False)
    low.until_fault(1.0)
    assert low.faults == [("motion", "motion")]
    low.run(0.5)
    line = [b - a for a, b in zip(LOW, (-1.0, -0.3, 0.5), strict=True)]
    shares = [(q - a) / d for q, a, d in zip(low.runtime.set_point.q_rad, LOW, line, strict=True)]
    assert shares == pytest.approx([shares[0]] * 3, abs=1e-9)  # on the line, so on the path


def test_no_set_point_of_a_jog_at_any_speed_is_below_the_floor() -> None:
    near = replace(RIGHT, table=None, limits=replace(RIGHT.limits, floor_z_m=0.06))  # 0.02 m below the tip
    source, guard, met = random.Random(6), Guard(near, JointLimits.of(RIGHT)), 0
    for _ in range(6):
        point, jogging = at_rest(LOW), Jogging(JogLimits.of(RIGHT), InverseKinematics(RIGHT), guard)
        for cycle in range(220):
            now_s = 0.002 * cycle
            if cycle % 55 == 0:
                asked = JointSpeeds((0.0, source.uniform(-1.0, 0.2), source.uniform(-1.0, 0.4)))
            if cycle % 40 == 0:
                jogging.ask(now_s, asked, point)
            point = jogging.advance(now_s, 0.002, point)
            assert guard.clearance(point.q_rad).distance_m >= 0.0
            met += bool(jogging.limited)
    assert met > 100


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
