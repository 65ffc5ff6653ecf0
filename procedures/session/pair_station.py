"""What a session of two arms in contact works with: both runtimes' ports, and on a mock the hands at both tips."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calib.closed_chain.conduct import ContactWatch, PairHand, PairStation
from calib.closed_chain.planning import base_of
from calib.closed_chain.room import Poses, SharedRoom
from calib.session.moves import ArmGeometry
from calib.session.plan import Target
from control.kinematics.kinematics import ForwardKinematics
from control.model.cell import Cell
from control.server.client import ArmClient
from procedures.mock import CellBench
from procedures.ports import HandPort, RuntimePort, move_together

Names = tuple[str, str]


def pair_station(
    cell: Cell,
    names: Names,
    clients: Mapping[str, ArmClient],
    speed: float,
    clock_offset_s: float = 0.0,
    hand: PairHand | None = None,
) -> PairStation:
    """`speed`: fraction of the joints' limits."""
    one, two = (cell.placed(name) for name in names)

    def together(poses_rad: Poses, fraction: float) -> None:
        moves = {
            name: {"q_rad": list(q_rad), "speed": speed * fraction}
            for name, q_rad in zip(names, poses_rad, strict=True)
        }
        move_together(clients, moves)

    return PairStation(
        names,
        (RuntimePort(clients[names[0]], speed), RuntimePort(clients[names[1]], speed)),
        (ArmGeometry(one.arm), ArmGeometry(two.arm)),
        together,
        SharedRoom(cell, (one, two)),
        ContactWatch((one.arm, two.arm), base_of(cell, names)),
        hand,
        clock_offset_s=clock_offset_s,
    )


class MockPairHand:
    """Hands that bring both tips to a contact. Its places are real: the ends of a bar are where the files say that they are."""

    def __init__(self, cell: Cell, names: Names, bench: CellBench) -> None:
        self._names, self._standing = names, bench.standing
        self._placed = [cell.placed(name) for name in names]
        self._models = [ForwardKinematics(placed.arm) for placed in self._placed]
        self._ports = [RuntimePort(bench.clients[name]) for name in names]
        self._hands = [HandPort(bench.hand(name), bench.wait) for name in names]

    def seat(self, target: Target) -> None:
        """One tip after the other, its drives off meanwhile; both then hold."""
        q_rad, count = target.q_rad or (), self._placed[0].arm.joint_count
        first, second = (
            np.array(placed.in_cell(model.tip(*q)))
            for placed, model, q in zip(
                self._placed, self._models, (q_rad[:count], q_rad[count:]), strict=True
            )
        )
        way = second - first
        places = (first, first + target.distance_m * way / max(float(np.linalg.norm(way)), 1e-9))
        for name, port, hand, place in zip(self._names, self._ports, self._hands, places, strict=True):
            port.release()
            hand.seat(self._standing.placed(name).in_base(place.tolist()))
            port.hold()

    def let_go(self) -> None:
        """Release both tips."""
        for hand in self._hands:
            hand.let_go()
