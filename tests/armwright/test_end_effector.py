"""Tool, gripper and pins of a running arm in Python."""

import math
from dataclasses import replace

import numpy as np
import pytest

import armwright
from control.model.arm import Tool
from control.model.end_effector import Digital
from tests.cell import GRIPPER

pytestmark = pytest.mark.usefixtures("nobody_below")

SHORT = replace(GRIPPER, travel_m=0.04)
RIGHT = armwright.load_arm("right")


def test_an_arm_grips_sets_an_output_and_changes_its_tool() -> None:
    arm = replace(
        RIGHT,
        tool=Tool(name="bare"),
        spare_tools=(Tool((0.0, 0.0, 0.1), name="cup"),),
        gripper=SHORT,
        digital=(Digital("valve", 1, 0, "output"), Digital("part", 2, 1, "input")),
    )
    with armwright.mock_arm(arm) as running:
        with pytest.raises(armwright.RequestRefused, match="OFF"):
            running.grip("open")
        running.enable()
        assert running.grip("open").state == "OPEN"
        running.put_between_fingers(0.02)
        held = running.grip("close", force_N=20.0)
        assert (held.state, held.has_lost) == ("GRIPPED", False)
        assert running.true_grip()[1] == pytest.approx(20.0, abs=3.0)
        assert running.grip().state == "GRIPPED"
        with pytest.raises(armwright.BadTarget, match="either"):
            running.grip("open", opening_m=0.01)
        running.set_output("valve", True)
        running.set_input("part", True)
        running.wait(0.1)
        assert running.digital() == {"valve": True, "part": True}
        running.mount("cup")
        running.tool("cup")
        assert running.arm.tool.name == "cup"
        moved_m = armwright.Kinematics(running.arm).forward(np.zeros(3)) - armwright.Kinematics(arm).forward(np.zeros(3))
        assert math.hypot(*moved_m) == pytest.approx(0.1)


def test_an_arm_without_a_gripper_says_so() -> None:
    with armwright.mock_arm(RIGHT) as running, pytest.raises(armwright.ArmError, match=r"add a \[gripper\]"):
        running.grip()
