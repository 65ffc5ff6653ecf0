"""A mock board on a wire of one bus: its control period passes whenever the host waits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from firmware_iface.node_bus import NodeBus
from tests.firmware_iface.bought.test_canopen import Wire

GOLDEN = Path(__file__).parent.parent / "golden"
CYCLE_S = 0.004
Frame = tuple[int, bytes]
Bus = TypeVar("Bus", bound=NodeBus[Any])


class BoardMock(Protocol):
    outgoing: list[Frame]

    def receive(self, can_id: int, payload: bytes, now_s: float) -> None: ...
    def tick(self, now_s: float, current_A: float, supply_V: float) -> None: ...


def golden(file: str, name: str) -> Frame:
    rows = (line.split(" | ") for line in (GOLDEN / file).read_text().splitlines() if line[0] != "#")
    found = {name_: (int(can_id, 16), bytes.fromhex(payload)) for name_, can_id, payload in rows}
    return found[name]


class MockWire(Wire):
    """`is_cut`: nothing that the board sends arrives."""

    def __init__(self, mock: BoardMock) -> None:
        super().__init__(self._answered)
        self.mock, self.is_cut = mock, False

    def wait_until_s(self, t: float) -> None:
        super().wait_until_s(t)
        self.mock.tick(t, 0.5, 24.0)
        for frame in self._taken():
            self.put(*frame)

    def run(self, duration_s: float) -> None:
        """Let time pass, a control period at a time."""
        for _ in range(round(duration_s * 1e3)):
            self.wait_until_s(self.now_s() + 1e-3)

    def _answered(self, can_id: int, payload: bytes) -> list[Frame]:
        self.mock.receive(can_id, payload, self.now_s())
        return list(self._taken())

    def _taken(self) -> Sequence[Frame]:
        frames, self.mock.outgoing = self.mock.outgoing, []
        return [] if self.is_cut else frames


class BusRig(Generic[Bus]):
    """A mock board on a wire, and the host's bus, drained once a cycle."""

    def __init__(self, mock: BoardMock, bus: Callable[[MockWire, MockWire], Bus]) -> None:
        self.wired = MockWire(mock)
        self.bus = bus(self.wired, self.wired)

    def run(self, duration_s: float) -> None:
        """Run the cycles of a time."""
        for _ in range(round(duration_s / CYCLE_S)):
            self.bus.flush()
            self.wired.run(CYCLE_S)
            self.bus.update()
