"""Injected faults on lines, boards and wiring, by scenario or operator. Seeded; several may be active.

Kinds and their `value` are listed in docs/mock_robot.md. Every fault has a start time and may have an end time;
faults on frames act on each frame with their probability.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from string import digits

from hil_mocks.errors import ScenarioError
from hil_mocks.scenario import FaultTable

_SLACK_S = 1e-9  # rounding of sums of ticks

ON_FRAMES = {"drop_frames", "corrupt_frames", "duplicate_frames", "delay_frames", "replay_frames", "silent"}
_IDENTITY = {"wrong_identity", "wrong_protocol", "wrong_counts", "board_reset"}
_BUILT_INTO_ENCODER = {"wrong_counts", "swapped_channels", "reversed_encoder", "wrong_encoder"}
_BUILT_INTO_MOTOR = {"wrong_counts", "swapped_motors", "wrong_gear"}
OF_ENCODER = (
    ON_FRAMES
    | _IDENTITY
    | _BUILT_INTO_ENCODER
    | {"stuck_encoder", "lost_wire", "quadrature_error", "loose_encoder"}
    | {"frozen_clock", "drifting_encoder", "slipped_encoder", "jumping_encoder", "backwards_encoder"}
)
OF_MOTOR = (
    ON_FRAMES
    | _IDENTITY
    | _BUILT_INTO_MOTOR
    | {"over_current", "over_temperature", "supply", "encoder_fault", "swapped_polarity"}
    | {"dead_motor", "stuck_joint", "says_current", "says_supply", "says_temperature"}
    | {"switched_off", "switched_on", "stuck_encoder"}
)
OF_BOUGHT = ON_FRAMES | {
    "board_reset",
    "e_stop",
    "over_current",
    "over_temperature",
    "supply",
    "swapped_polarity",
    "dead_motor",
    "stuck_joint",
    "stuck_encoder",
    "switched_off",
    "switched_on",
}
OF_CAMERA = (ON_FRAMES - {"delay_frames", "replay_frames"}) | {"exchanged_bodies"}  # its latency is a separate key
BUILT_IN = _BUILT_INTO_ENCODER | _BUILT_INTO_MOTOR  # before power-up
_NEED_VALUE = {
    "delay_frames",
    "replay_frames",
    "wrong_identity",
    "wrong_protocol",
    "wrong_counts",
    "swapped_channels",
    "swapped_motors",
    "wrong_encoder",
    "wrong_gear",
    "supply",
    "drifting_encoder",
    "slipped_encoder",
    "jumping_encoder",
    "says_current",
    "says_supply",
    "says_temperature",
}
Frames = list[tuple[float, bytes]]  # (arrival time at the host, frame)


def check_fault(fault: FaultTable, boards: Sequence[str], where: str) -> None:
    """Raise ScenarioError unless the board exists and can have the fault."""
    known = {"encoder": OF_ENCODER, "motor": OF_MOTOR, "camera": OF_CAMERA, "roboclaw": OF_BOUGHT}
    place = f'{where}: fault "{fault.kind}"'
    if fault.board not in boards:
        raise ScenarioError(f'{place}: no board "{fault.board}"; there are {", ".join(boards)}.')
    kinds = known.get(fault.board.rstrip(digits), OF_BOUGHT - {"e_stop", "stuck_encoder"})
    if fault.kind not in kinds:
        raise ScenarioError(f"{place}: expected one of {', '.join(sorted(kinds))}.")
    if fault.kind in BUILT_IN and fault.at_s > 0.0:
        raise ScenarioError(f"{place}: is wired in before power-up; at_s must be 0, got {fault.at_s:g}.")
    if fault.kind in _NEED_VALUE and fault.value is None:
        raise ScenarioError(f'{place}: needs "value".')
    if fault.until_s is not None and fault.until_s <= fault.at_s:
        raise ScenarioError(f"{place}: until_s = {fault.until_s:g} is not after at_s = {fault.at_s:g}.")


class FaultPlan:
    """All faults by time. `update` has nothing to do before `next_change_s`."""

    def __init__(self, faults: Sequence[FaultTable]) -> None:
        self._faults = list(faults)
        self.active: tuple[FaultTable, ...] = ()
        self.next_change_s = 0.0 if faults else float("inf")

    def add(self, fault: FaultTable) -> None:
        """Add a fault."""
        self._faults.append(fault)
        self.next_change_s = 0.0

    def clear(self) -> None:
        """Remove all faults."""
        self._faults.clear()
        self.next_change_s = 0.0

    def update(self, now_s: float) -> tuple[list[FaultTable], list[FaultTable]]:
        """Faults that have started and ended since the last call."""
        moment_s = now_s + 1e-9
        active = tuple(f for f in self._faults if f.at_s <= moment_s and (f.until_s is None or moment_s < f.until_s))
        begun = [f for f in active if not any(f is g for g in self.active)]
        ended = [f for f in self.active if not any(f is g for g in active)]
        self.active = active
        edges = [t for f in self._faults for t in (f.at_s, f.until_s) if t is not None and t > moment_s]
        self.next_change_s = min(edges, default=float("inf"))
        return begun, ended

    def on_frames(self, board: str) -> tuple[FaultTable, ...]:
        """The active faults of a board that act on its frames."""
        return tuple(f for f in self.active if f.board == board and f.kind in ON_FRAMES)


class FaultyFrames:
    """Faults on the frames of one board to the host."""

    def __init__(self, board: str, seed: int) -> None:
        self._random = random.Random(f"line {board} {seed}")
        self.faults: tuple[FaultTable, ...] = ()

    @property
    def is_silent(self) -> bool:
        """Whether nothing is transmitted in either direction."""
        return bool(self.faults) and any(fault.kind == "silent" for fault in self.faults)

    def passed(self, frames: Frames) -> Frames:
        """The frames as they arrive, in the order of sending."""
        for fault in self.faults:
            frames = [arrived for sent in frames for arrived in self._through(fault, *sent)]
        return frames

    def _through(self, fault: FaultTable, when_s: float, frame: bytes) -> Frames:
        if self._random.random() >= fault.probability:
            return [(when_s, frame)]
        match fault.kind:
            case "duplicate_frames":
                return [(when_s, frame), (when_s, frame)]
            case "replay_frames":
                return [(when_s, frame), (when_s + (fault.value or 0.0), frame)]
            case "delay_frames":
                return [(when_s + (fault.value or 0.0), frame)]
            case "corrupt_frames":
                return [(when_s, self._flipped(frame))]
        return []

    def _flipped(self, frame: bytes) -> bytes:
        """Flip one bit."""
        at = self._random.randrange(8 * len(frame))
        changed = bytearray(frame)
        changed[at // 8] ^= 1 << at % 8
        return bytes(changed)


class CanOut:
    """Frames from boards to the host on a CAN bus; faults of a board's line act on its frames."""

    def __init__(self) -> None:
        self.outgoing: list[tuple[int, bytes]] = []
        self._on_its_way: list[tuple[float, tuple[int, bytes]]] = []

    def send(self, line: FaultyFrames, frames: Sequence[tuple[int, bytes]], now_s: float) -> None:
        """Send a board's frames through its line."""
        if not line.faults:
            self.outgoing += frames
            return
        for can_id, payload in frames:
            for when_s, arrived in line.passed([(now_s, payload)]):
                self._on_its_way.append((when_s, (can_id, arrived)))
        self.release(now_s)

    def release(self, now_s: float) -> None:
        """Hand on what arrives by now."""
        if self._on_its_way:
            moment_s = now_s + _SLACK_S
            self.outgoing += [frame for when_s, frame in self._on_its_way if when_s <= moment_s]
            self._on_its_way = [sent for sent in self._on_its_way if sent[0] > moment_s]
