"""An arm on bought boards: the same joints, motors and limits, driven by boards of other kinds."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from control.errors import ArmError
from control.model.arm import ENCODER_CHANNELS, Arm, Board, Drive, DrivePid
from control.model.board_kinds import KINDS

MIXED: Final = "mixed"
MIXED_KINDS: Final = ("roboclaw", "dynamixel")
"""Of `mixed`: all joints but the last, and the last."""
REFERENCE: Final = "reference"
NAMES: Final = (*KINDS, MIXED)

STALE_CYCLES = 6  # a board that is asked in turn answers every cycle or two
HOMING_SPEED_rad_s: Final = 0.3  # up to the switch; the index that gives the zero is latched by the board
# Where the edge gives the zero, it is seen some 25 ms late, at 0.3 of this: below a milliradian.
EDGE_SPEED_rad_s: Final = 0.1
BAUD: Final = {"roboclaw": 460_800, "dynamixel": 1_000_000, "feetech": 1_000_000}


def on_boards(arm: Arm, kinds: str | Sequence[str]) -> Arm:
    """Return the arm with all drives on boards of a kind, on MIXED_KINDS, or each on one of its own. ArmError lists the kinds.

    A drive of kind REFERENCE stays on the arm's reference boards. Ports are the names of the lines.
    """
    for kind in (kinds,) if isinstance(kinds, str) else kinds:
        if kind not in (*NAMES, REFERENCE):
            raise ArmError(f"boards: expected one of {', '.join(NAMES)}, got {kind}")
    boards: list[Board] = []
    drives: list[Drive] = []
    kind_of_drive = _each(kinds, len(arm.drives))
    for i, (drive, kind) in enumerate(zip(arm.drives, kind_of_drive, strict=True)):
        before = kind_of_drive[:i].count(kind)
        if kind == REFERENCE:
            board, channel = divmod(before, ENCODER_CHANNELS)
            drives.append(replace(drive, encoder_board=board, encoder_channel=channel))
            continue
        motors = KINDS[kind].motors
        if before % motors == 0:
            boards.append(_board(kind, before // motors, drive.gear_ratio))
        its_own = next(board for board in reversed(boards) if board.kind == kind)
        drives.append(_on_board(drive, its_own, 1 + before % motors))
    return _with(arm, boards, drives) if boards else arm


def serial_lines(kinds: Sequence[str]) -> tuple[str, ...]:
    """The serial lines of boards of these kinds, a kind a joint: encoder boards, RoboClaws, a line a kind of servos."""
    encoders = -(-kinds.count(REFERENCE) // ENCODER_CHANNELS)
    claws = -(-kinds.count("roboclaw") // KINDS["roboclaw"].motors)
    servos = [kind for kind in dict.fromkeys(kinds) if kind in BAUD and kind != "roboclaw"]
    return (
        *(f"encoder board {number + 1}" for number in range(encoders)),
        *(f"roboclaw{number + 1}" for number in range(claws)),
        *servos,
    )


def _each(kinds: str | Sequence[str], joints: int) -> list[str]:
    if kinds == MIXED:
        return [MIXED_KINDS[joint == joints - 1] for joint in range(joints)]
    return [kinds] * joints if isinstance(kinds, str) else list(kinds)


def _board(kind: str, number: int, gear_ratio: float) -> Board:
    """The board of this number, from 0. RoboClaws have a line each; boards of another kind share one."""
    first = max(KINDS[kind].addresses.start, 1)
    if KINDS[kind].line == "can":
        # An ODrive tells of no switch: the arm's are set up to know the joint's angle.
        is_absolute = not KINDS[kind].has_switch
        turns = round(gear_ratio, 9) if is_absolute else None  # the encoder is at the joint
        return Board(f"{kind}{number + 1}", kind, first + number, absolute=is_absolute, absolute_turns=turns)
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
        encoder_counts_per_rev=kind.counts_per_turn or drive.encoder_counts_per_rev,
        pid=DrivePid(kind.modes[0]),
    )
    if kind.is_absolute:
        return _at_the_output(moved)
    if board.absolute:
        return replace(moved, home=None)
    # No index pulse: the edge of the switch is the zero.
    home = drive.home
    if home:
        speed_rad_s = min(home.speed_rad_s, EDGE_SPEED_rad_s)
        home = replace(home, index_rad=home.switch_rad, speed_rad_s=speed_rad_s)
    return replace(moved, home=home)


def _at_the_output(drive: Drive) -> Drive:
    """A servo: its gear is inside, so its values are those of the output shaft."""
    ratio = drive.gear_ratio
    return replace(
        drive,
        gear_ratio=1.0,
        zero_count=drive.zero_count or drive.encoder_counts_per_rev // 2,
        torque_constant_Nm_A=ratio * drive.torque_constant_Nm_A,
        rotor_inertia_kg_m2=ratio**2 * drive.rotor_inertia_kg_m2,
        home=None,
    )


def _with(arm: Arm, boards: list[Board], drives: list[Drive]) -> Arm:
    kinds = {board.kind for board in boards}
    slowest_Hz = min(KINDS[kind].usual_rate_Hz for kind in kinds)
    stale_s = max(arm.limits.stale_s, STALE_CYCLES / slowest_Hz)
    reference = sum(not drive.board for drive in drives)
    is_on_can = reference or any(KINDS[kind].line == "can" for kind in kinds)
    return replace(
        arm,
        boards=tuple(boards),
        drives=tuple(drives),
        encoder_boards=arm.encoder_boards[: -(-reference // ENCODER_CHANNELS)],
        can=arm.can if is_on_can else None,
        limits=replace(arm.limits, stale_s=stale_s),
    )
