"""What gripper and pins add to the load of the CAN bus."""

from control.end_effector import gripper, outputs
from control.model.arm import Arm

GRIPPER_FRAMES = 4  # a COMMAND, a question for the count, and their answers
PIN_FRAMES = 2  # a DIGITAL_COMMAND and its reply, for each board with pins


def end_frames_Hz(arm: Arm) -> float:
    """Frames a second, whatever the rate of the loop."""
    grips = GRIPPER_FRAMES / gripper.PERIOD_s if arm.gripper is not None else 0.0
    return grips + PIN_FRAMES * len({pin.board for pin in arm.digital}) / outputs.PERIOD_s
