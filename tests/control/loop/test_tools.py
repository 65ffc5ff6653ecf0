"""Another tool is on: tip, masses, recording and what refuses it, on the mock."""

import math
from collections.abc import Iterator
from dataclasses import replace

import pytest

from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Tool
from control.motion.plan import plan_path
from control.recording.record import layout_of
from control.safety.modes import Mode
from tests.cell import RIGHT, Cell, holding_cell, scenario

PEN = Tool((0.0, 0.0, 0.1), name="pen", mass_kg=0.1)
CUP = Tool((0.05, 0.0, 0.15), name="cup", mass_kg=1.2, com_m=(0.0, 0.0, 0.1))
TWO = replace(RIGHT, tool=PEN, spare_tools=(CUP,))
RAISED = (0.1, -0.3, 0.9)


@pytest.fixture
def cell() -> Iterator[Cell]:
    with holding_cell(scenario(RAISED), TWO) as cell:
        yield cell


def carried_on(cell: Cell, tool: str) -> Arm:
    cell.rig.set_tool(tool)
    cell.client.tool(tool)
    return TWO.with_tool(tool)


def test_the_tip_of_the_status_is_that_of_the_tool_and_of_the_truth(cell: Cell) -> None:
    for name in ("cup", "pen"):
        carried_on(cell, name)
        cell.run(3.0)
        status = cell.client.status()
        assert (status["tool"], status["tools"]) == (name, ["pen", "cup"])
        assert math.dist(status["tip_m"], cell.rig.tip_m()) < 1e-3


def test_a_heavier_tool_moves_the_arm_slowly_and_little(cell: Cell) -> None:
    speeds, before = cell.true_speeds(), cell.rig.joint_rad()
    carried_on(cell, "cup")
    cell.run(2.5)
    assert cell.mode is Mode.HOLDING
    assert cell.runtime.parts.loads.masses_kg == {CUP.centre_m: 1.2}
    assert max(speeds) < 0.2
    assert max(abs(a - b) for a, b in zip(before, cell.rig.joint_rad(), strict=True)) < 2e-3


def test_a_tool_is_not_changed_while_the_arm_moves_or_by_a_wrong_name(cell: Cell) -> None:
    assert "expected one of pen, cup" in cell.refusal(do="tool", name="saw")
    cell.start_move((0.4, -0.3, 0.9))
    assert "the arm is MOVING" in cell.refusal(do="tool", name="cup")
    assert cell.runtime.parts.tool.tool is PEN


def test_a_path_runs_with_the_tool_that_it_was_planned_for_and_no_other(cell: Cell) -> None:
    arm = carried_on(cell, "cup")
    x, y, z = ForwardKinematics(arm).tip(*RAISED)
    path = plan_path(arm, [(x, y, z), (x, y + 0.05, z)], 0.1, q_near_rad=RAISED)
    cell.client.move_joints(path.q_start_rad)
    assert "'cup' is mounted: plan it again" in cell.refusal(do="run_path", path=path.to_message(), tool="pen")
    cell.client.run_path(path.to_message(), tool="cup")
    assert math.dist(cell.rig.tip_m(), (x, y + 0.05, z)) < 2e-3


def test_the_guard_holds_the_tip_of_the_tool_that_is_on_above_the_floor() -> None:
    """The wrist is above the floor where the long tool's tip would be under it."""
    long = Tool((-0.4, 0.0, 0.0), name="long")
    low = (0.1, -0.6, 0.2)
    with holding_cell(scenario(RAISED), replace(RIGHT, tool=PEN, spare_tools=(long,))) as cell:
        before, after = (ForwardKinematics(cell_arm).tip(*low)[2] for cell_arm in (RIGHT, replace(RIGHT, tool=long)))
        assert after < -0.02 < before
        cell.client.tool("long")
        assert "floor" in cell.refusal(do="move_joints", q_rad=list(low))
        cell.client.tool("pen")
        cell.start_move(low)


def test_each_row_says_which_tool_was_on(cell: Cell) -> None:
    layout, rows = layout_of(TWO), []
    cell.watchers.append(lambda: rows.append(cell.runtime.parts.recorder.last_rows()[-1]))
    for name in ("cup", "pen"):
        cell.client.tool(name)
        cell.run(0.01)
    at = layout.names.index("tool")
    seen = [layout.packing.unpack(row)[at] for row in rows]
    assert sorted(set(seen)) == [0, 1]
    assert seen == sorted(seen, reverse=True)
