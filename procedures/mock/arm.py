"""An arm.toml for a mock arm: the arm's own, with the mock's ports."""

from dataclasses import replace

from control.model.arm import Arm, Camera, CanBus, EncoderBoardPort
from hil_mocks.rig import MockPorts

# The mock's boards and the loop share this machine with other programs, and a virtual machine may stall either for some
# tenths of a second. Real boards are not stalled, so 20 ms of silence matter there; a mock arm is harmless.
SHARED_MACHINE_STALE_S = 0.3
SHARED_MACHINE_WATCHDOG_S = 0.5
SHARED_MACHINE_LAG_S = 0.5


def wired_to(arm: Arm, rig: MockPorts) -> Arm:
    """The arm with the mock's serial port, CAN bus and camera port, and with longer timeouts for boards on a shared machine."""
    boards = tuple(
        replace(arm.encoder_boards[i], port=url)
        if i < len(arm.encoder_boards)
        else EncoderBoardPort(f"enc{i}", url)
        for i, url in enumerate(rig.encoder_urls)
    )
    return replace(
        arm,
        encoder_boards=boards,
        boards=tuple(replace(board, port=rig.board_urls.get(board.port, board.port)) for board in arm.boards),
        can=CanBus(rig.can_interface, rig.can_channel, options=rig.can_options),
        camera=(arm.camera or Camera()).on_this_machine(rig.camera_port),
        limits=replace(
            arm.limits,
            stale_s=max(arm.limits.stale_s, SHARED_MACHINE_STALE_S),
            watchdog_s=max(arm.limits.watchdog_s, SHARED_MACHINE_WATCHDOG_S),
            following_error_per_speed_s=max(arm.limits.following_error_per_speed_s, SHARED_MACHINE_LAG_S),
        ),
    )
