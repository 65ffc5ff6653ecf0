"""What a fault of a scenario changes in a mock board itself; its wires, its motor and its shaft are the robot's."""

import struct
from collections.abc import Callable, Sequence
from dataclasses import replace

from hil_mocks.devices.encoder_inputs import EncoderBoardHardware
from hil_mocks.devices.motor_inputs import MotorBoardHardware
from hil_mocks.scenario import FaultTable

_FORCED = {"over_current": 1, "over_temperature": 2, "encoder_fault": 32}  # bits of the motor board's faults


# Controlwords that another program would send to take a board out of operation, and into it to hold (docs/motor_board.md).
_SENT = {"switched_off": (0x00,), "switched_on": (0x06, 0x07, 0x0F)}


def switch_motor_board(board: MotorBoardHardware, fault: FaultTable, is_on: bool, now_s: float) -> None:
    """Begin or end a fault of a motor board; kinds that it does not have change nothing."""
    if fault.kind.startswith("says_"):
        board.says[fault.kind] = fault.value if is_on else None
    elif fault.kind in _FORCED:
        bit = _FORCED[fault.kind]
        board.forced_faults = board.forced_faults | bit if is_on else board.forced_faults & ~bit
    elif fault.kind in _SENT and is_on:  # unheard by the host: not on its bus
        for controlword in _SENT[fault.kind]:
            board.receive(0x100 + board.setup.node, struct.pack("<BBih", controlword, 4, 0, 0), now_s)
    elif fault.kind == "board_reset" and is_on:
        board.power_up()
    elif fault.kind == "wrong_identity" and is_on:
        board.setup = replace(board.setup, serial_number=int(fault.value or 0))
    elif fault.kind == "wrong_protocol" and is_on:
        board.setup = replace(board.setup, protocol=int(fault.value or 0))
    elif fault.kind == "wrong_counts" and is_on:
        board.setup = replace(board.setup, counts_per_turn=int(fault.value or 0))


def switch_encoder_board(
    board: EncoderBoardHardware,
    fault: FaultTable,
    is_on: bool,
    now_s: float,
    counts: Callable[[], Sequence[int]],
) -> None:
    """Begin or end a fault of an encoder board; `counts`: of its shafts now, from which it starts after a reset."""
    sets = {"stuck_encoder": board.stuck, "lost_wire": board.lost, "backwards_encoder": board.backwards}
    if fault.kind in sets:
        change: Callable[[int], None] = sets[fault.kind].add if is_on else sets[fault.kind].discard
        change(fault.channel)
    elif fault.kind == "quadrature_error" and is_on:
        board.quadrature_error(fault.channel, round(fault.value or 1))
    elif fault.kind == "slipped_encoder" and is_on:
        board.slip(fault.channel, round(fault.value or 0))
    elif fault.kind == "jumping_encoder" and is_on:
        board.jump(fault.channel, round(fault.value or 0))
    elif fault.kind == "drifting_encoder":
        board.drift.pop(fault.channel, None)
        if is_on:
            board.drift[fault.channel] = fault.value or 0.0
    elif fault.kind == "frozen_clock":
        board.freeze_clock(is_on)
    elif fault.kind == "board_reset" and is_on:
        board.power_up(now_s, counts())
    elif fault.kind == "wrong_identity" and is_on:
        board.setup = replace(board.setup, serial_number=int(fault.value or 0))
    elif fault.kind == "wrong_protocol" and is_on:
        board.setup = replace(board.setup, protocol=int(fault.value or 0))
