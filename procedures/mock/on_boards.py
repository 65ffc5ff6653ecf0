"""An arm on bought boards: the same joints, motors and limits, driven by boards of another kind."""

from dataclasses import replace
from typing import Final

from control.errors import ArmError
from control.model.arm import Arm, Board, Drive, DrivePid
from control.model.board_kinds import KINDS

MIXED: Final = "mixed"
MIXED_KINDS: Final = ("roboclaw", "dynamixel")
"""Of `mixed`: all joints but the last, and the last."""
NAMES: Final = (*KINDS, MIXED)

STALE_CYCLES = 6  # a board that is asked in turn answers every cycle or two
HOMING_SPEED_rad_s = 0.1  # a switch is seen a cycle late at most: a tenth of a millimetre at the tip
SERVO_COUNTS_PER_TURN = 4096
VESC_COUNTS_PER_TURN = 18_000
BAUD: Final = {"roboclaw": 460_800, "dynamixel": 1_000_000, "feetech": 1_000_000}


def on_boards(arm: Arm, kind: str) -> Arm:
    """Return the arm with all drives on boards of a kind, or on MIXED_KINDS. ArmError lists the kinds."""
    if kind not in NAMES:
        raise ArmError(f"boards: expected one of {', '.join(NAMES)}, got {kind}")
    last = len(arm.drives) - 1
    kinds = [MIXED_KINDS[i == last] if kind == MIXED else kind for i in range(last + 1)]
    boards: list[Board] = []
    drives = []
    for i, (drive, its_kind) in enumerate(zip(arm.drives, kinds, strict=True)):
        before = kinds[:i].count(its_kind)
        motors = KINDS[its_kind].motors
        if before % motors == 0:
            boards.append(_board(its_kind, before // motors))
        drives.append(_on_board(drive, boards[-1], 1 + before % motors))
    return _with(arm, boards, drives)


def _board(kind: str, number: int) -> Board:
    """The board of this number, from 0. RoboClaws have a line each; boards of another kind share one."""
    first = max(KINDS[kind].addresses.start, 1)
    if KINDS[kind].line == "can":
        # An ODrive tells of no switch: the arm's are set up to know the joint's angle.
        return Board(f"{kind}{number + 1}", kind, first + number, absolute=not KINDS[kind].has_switch)
    if kind == "roboclaw":
        return Board(f"{kind}{number + 1}", kind, first, f"{kind}{number + 1}", BAUD[kind])
    return Board(f"{kind}{number + 1}", kind, first + number, kind, BAUD[kind])


def _on_board(drive: Drive, board: Board, channel: int) -> Drive:
    kind = KINDS[board.kind]
    moved = replace(
        drive,
        board=board.name,
        board_channel=channel,
        encoder_board=-1,
        encoder_channel=-1,
        motor_node=-1,
        pid=DrivePid(kind.modes[0]),
    )
    if kind.is_absolute:
        return _at_the_output(moved)
    if board.kind == "vesc":
        moved = replace(moved, encoder_counts_per_rev=VESC_COUNTS_PER_TURN)
    if board.absolute:
        return replace(moved, home=None)
    # No index pulse: the edge of the switch is the zero.
    home = drive.home and replace(drive.home, index_rad=drive.home.switch_rad, speed_rad_s=HOMING_SPEED_rad_s)
    return replace(moved, home=home)


def _at_the_output(drive: Drive) -> Drive:
    """A servo: its gear is inside, so its values are those of the output shaft."""
    ratio = drive.gear_ratio
    return replace(
        drive,
        gear_ratio=1.0,
        encoder_counts_per_rev=SERVO_COUNTS_PER_TURN,
        zero_count=SERVO_COUNTS_PER_TURN // 2,
        torque_constant_Nm_A=ratio * drive.torque_constant_Nm_A,
        rotor_inertia_kg_m2=ratio**2 * drive.rotor_inertia_kg_m2,
        home=None,
    )


def _with(arm: Arm, boards: list[Board], drives: list[Drive]) -> Arm:
    kinds = {board.kind for board in boards}
    slowest_Hz = min(KINDS[kind].usual_rate_Hz for kind in kinds)
    stale_s = max(arm.limits.stale_s, STALE_CYCLES / slowest_Hz)
    return replace(
        arm,
        boards=tuple(boards),
        drives=tuple(drives),
        encoder_boards=(),
        can=arm.can if any(KINDS[kind].line == "can" for kind in kinds) else None,
        limits=replace(arm.limits, stale_s=stale_s),
    )
