"""An arm.toml for a mock arm: the arm's own, with the mock's ports in place of its own."""

from dataclasses import replace

from control.model.arm import Arm, Camera, CanBus, EncoderBoardPort
from hil_mocks.rig import MockArm

# The mock's boards share this machine with everything else, which may keep them waiting for 40 to 170 ms; real boards do not
# wait, and 20 ms of silence mean something there.
SHARED_MACHINE_STALE_S = 0.15


def wired_to(arm: Arm, rig: MockArm) -> Arm:
    """The arm with the mock's serial port, CAN bus and camera port, and with patience for boards on a shared machine."""
    boards = tuple(
        replace(arm.encoder_boards[i], port=url)
        if i < len(arm.encoder_boards)
        else EncoderBoardPort(f"enc{i}", url)
        for i, url in enumerate(rig.encoder_urls)
    )
    return replace(
        arm,
        encoder_boards=boards,
        can=CanBus(rig.can_interface, rig.can_channel, options=rig.can_options),
        camera=replace(arm.camera or Camera(), udp_port=rig.camera_port),
        limits=replace(arm.limits, stale_s=max(arm.limits.stale_s, SHARED_MACHINE_STALE_S)),
    )
