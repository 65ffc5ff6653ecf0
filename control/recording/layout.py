"""Which columns an arm's recording has, and what its header says about them."""

from typing import Any

from control.dynamics.joint_side import has_joint_side
from control.model.arm import Arm
from control.recording.record import Layout

TOOL_FIELD = ("tool", "B")  # index into the header's `tools`
END_FIELDS = (TOOL_FIELD,)  # all that there may be


def layout_of(arm: Arm) -> Layout:
    """The columns for an arm: joint angles where they differ from the encoders', the tool where there are several."""
    more = [TOOL_FIELD] if arm.spare_tools else []
    return Layout.of(arm.joint_count, has_joint_side(arm), more)


def about_columns(arm: Arm) -> dict[str, Any]:
    """What the header of the arm's recording says for these columns."""
    return {"tools": [tool.name for tool in arm.tools]} if arm.spare_tools else {}
