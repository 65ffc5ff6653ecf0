"""Which columns an arm's recording has, and what its header says about them."""

from typing import Any

from control.dynamics.joint_side import has_joint_side
from control.end_effector.grip_state import GripState
from control.model.arm import Arm
from control.model.cell import Cell
from control.recording.record import Layout

TOOL_FIELD = ("tool", "B")  # index into the header's `tools`
GRIPPER_FIELDS = (("gripper_m", "f"), ("gripper_goal_m", "f"), ("gripper_A", "f"), ("gripper_state", "B"))
DIGITAL_FIELD = ("digital", "I")  # bits, in the order of the header's `digital`
END_FIELDS = (TOOL_FIELD, *GRIPPER_FIELDS, DIGITAL_FIELD)  # all that there may be


def layout_of(arm: Arm) -> Layout:
    """The columns for an arm: joint angles where they differ from the encoders', and what is at its end."""
    more = [TOOL_FIELD] if arm.spare_tools else []
    more += GRIPPER_FIELDS if arm.gripper is not None else ()
    more += [DIGITAL_FIELD] if arm.digital else []
    return Layout.of(arm.joint_count, has_joint_side(arm), more)


def about_columns(arm: Arm) -> dict[str, Any]:
    """What the header of the arm's recording says for these columns."""
    about: dict[str, Any] = {}
    if arm.spare_tools:
        about["tools"] = [tool.name for tool in arm.tools]
    if arm.gripper is not None:
        about["gripper_states"] = [state.name for state in GripState]
    if arm.digital:
        about["digital"] = [pin.name for pin in arm.digital]
    return about


def about_cell(cell: Cell, arm: str) -> dict[str, Any]:
    """What the header of an arm's recording says of the cell that it is in: all bases; nothing of an arm alone."""
    if len(cell.arms) == 1:
        return {}
    bases = {
        placed.name: {"origin_m": placed.origin_m, "orientation": placed.orientation} for placed in cell.arms
    }
    return {"cell": {"name": cell.name, "arm": arm, "bases": bases}}
