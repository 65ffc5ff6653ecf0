"""The reference arm on each kind of board, and the period at which its loop runs."""

from dataclasses import dataclass, replace

from control.model.arm import Arm, Board
from control.model.board_kinds import KINDS
from tests.cell import RIGHT


@dataclass(frozen=True, slots=True)
class OnBoards:
    """An arm, the loop's period, and what the mock calls the boards of joints 1 and 3."""

    arm: Arm
    period_s: float
    first: str
    last: str


def with_roboclaws(ports: tuple[str, ...] = ("base", "elbow"), baud: int = 460_800) -> Arm:
    """Two RoboClaws, each on a line of its own, or on one line; joints 1 and 2 on the first."""
    is_shared = len(set(ports)) == 1
    boards = tuple(
        Board(f"claw{i + 1}", "roboclaw", 0x80 + (i if is_shared else 0), port, baud)
        for i, port in enumerate(ports)
    )
    drives = []
    for drive in RIGHT.drives:
        board, channel = divmod(drive.joint - 1, KINDS["roboclaw"].motors)
        home = drive.home and replace(drive.home, index_rad=drive.home.switch_rad, speed_rad_s=0.1)
        drives.append(
            replace(
                drive,
                board=boards[board].name,
                board_channel=channel + 1,
                encoder_board=-1,
                encoder_channel=-1,
                motor_node=-1,
                home=home,
            )
        )
    limits = replace(RIGHT.limits, stale_s=0.06)
    return replace(
        RIGHT, boards=boards, drives=tuple(drives), encoder_boards=(), can=None, limits=limits, path=None
    )


def with_cia402(mode: str = "position") -> Arm:
    """A CiA 402 drive for each joint, nodes 11, 12 and 13."""
    boards = tuple(Board(f"axis{drive.joint}", "cia402", 10 + drive.joint) for drive in RIGHT.drives)
    drives = tuple(
        replace(
            drive,
            board=f"axis{drive.joint}",
            encoder_board=-1,
            encoder_channel=-1,
            motor_node=-1,
            pid=replace(drive.pid, mode=mode),
            home=drive.home and replace(drive.home, index_rad=drive.home.switch_rad, speed_rad_s=0.1),
        )
        for drive in RIGHT.drives
    )
    return replace(RIGHT, boards=boards, drives=drives, encoder_boards=(), path=None)


def with_dynamixels() -> Arm:
    """A servo for each joint on one line; its gear is in the servo, so the drive has that of its output shaft."""
    boards = tuple(
        Board(f"servo{drive.joint}", "dynamixel", drive.joint, "servos", 1_000_000) for drive in RIGHT.drives
    )
    drives = tuple(
        replace(
            drive,
            board=f"servo{drive.joint}",
            encoder_board=-1,
            encoder_channel=-1,
            motor_node=-1,
            gear_ratio=1.0,
            encoder_counts_per_rev=4096,
            zero_count=2048,
            torque_constant_Nm_A=drive.gear_ratio * drive.torque_constant_Nm_A,
            rotor_inertia_kg_m2=drive.gear_ratio**2 * drive.rotor_inertia_kg_m2,
            pid=replace(drive.pid, mode="position"),
            home=None,
        )
        for drive in RIGHT.drives
    )
    limits = replace(RIGHT.limits, stale_s=0.06)
    return replace(RIGHT, boards=boards, drives=drives, encoder_boards=(), can=None, limits=limits, path=None)


def mixed() -> Arm:
    """Joints 1 and 2 on a RoboClaw, joint 3 on reference boards."""
    claws = with_roboclaws()
    drives = (*claws.drives[:2], RIGHT.drives[2])
    return replace(
        claws, boards=claws.boards[:1], drives=drives, encoder_boards=RIGHT.encoder_boards, can=RIGHT.can
    )


ON_BOARDS = {
    "reference": OnBoards(RIGHT, 0.002, "motor1", "motor3"),
    "cia402": OnBoards(with_cia402(), 0.004, "drive11", "drive13"),
    "cia402 torque": OnBoards(with_cia402("current"), 0.002, "drive11", "drive13"),
    "dynamixel": OnBoards(with_dynamixels(), 0.01, "servo1", "servo3"),
    "mixed": OnBoards(mixed(), 0.01, "roboclaw1", "motor3"),
    "roboclaw": OnBoards(with_roboclaws(), 0.01, "roboclaw1", "roboclaw2"),
}
