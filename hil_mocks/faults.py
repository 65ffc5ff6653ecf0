"""Injected faults on lines, boards and wiring, by scenario or operator. Seeded; several may be active.

`armwright arm --keys scenario` prints the kinds. Every fault has a start time and may have an end time; faults on frames act on
each frame with their probability.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass
from string import digits
from typing import Final

from control.model.reference import FileSection, Key
from hil_mocks.errors import ScenarioError
from hil_mocks.scenario import FaultTable

_SLACK_S = 1e-9  # rounding of sums of ticks


@dataclass(frozen=True, slots=True)
class FaultKind:
    """A kind of fault: which boards can have it, what it does, and what its `value` is."""

    boards: str  # words of BOARDS
    text: str
    value: str = ""  # what it is; "": it has none
    is_value_needed: bool = True
    is_on_frames: bool = False
    is_built_in: bool = False  # before power-up


BOARDS: Final = {
    "encoder": "of an encoder board, or of its `channel`",
    "motor": "of a motor board",
    "camera": "of the camera",
    "bought": "of a bought board",
    "roboclaw": "of a RoboClaw, or of its `channel`, besides",
}
_ANY = "encoder motor bought roboclaw"
KINDS: Final = {
    "drop_frames": FaultKind(f"{_ANY} camera", "a frame to the host is lost", is_on_frames=True),
    "corrupt_frames": FaultKind(f"{_ANY} camera", "one bit of it is wrong", is_on_frames=True),
    "duplicate_frames": FaultKind(f"{_ANY} camera", "it comes twice", is_on_frames=True),
    "delay_frames": FaultKind(_ANY, "it comes later", "s", is_on_frames=True),
    "replay_frames": FaultKind(_ANY, "it comes again", "s later", is_on_frames=True),
    "silent": FaultKind(f"{_ANY} camera", "nothing is sent, and nothing heard", is_on_frames=True),
    "board_reset": FaultKind(_ANY, "it restarts, once"),
    "wrong_identity": FaultKind("encoder motor", "another serial number", "the number"),
    "wrong_protocol": FaultKind("encoder motor", "another protocol version", "the version"),
    "wrong_counts": FaultKind(
        "encoder motor",
        "it reports other counts, and of an encoder board the channel gives them",
        "counts a turn",
        is_built_in=True,
    ),
    "stuck_encoder": FaultKind("encoder motor roboclaw", "the count that it reads stands"),
    "lost_wire": FaultKind("encoder", "a line of the encoder is broken"),
    "quadrature_error": FaultKind("encoder", "counts are lost or gained, once", "counts (1)", is_value_needed=False),
    "swapped_channels": FaultKind("encoder", "two plugs are changed over", "the other channel", is_built_in=True),
    "reversed_encoder": FaultKind("encoder", "it counts down for up", is_built_in=True),
    "wrong_encoder": FaultKind("encoder", "another encoder than its boards report", "counts a turn", is_built_in=True),
    "drifting_encoder": FaultKind("encoder", "the count drifts", "counts a second"),
    "slipped_encoder": FaultKind("encoder", "it slips on its shaft, with its index, once", "counts"),
    "jumping_encoder": FaultKind("encoder", "its counter jumps unseen, once; the index stays", "counts"),
    "backwards_encoder": FaultKind("encoder", "it counts the wrong way"),
    "loose_encoder": FaultKind("encoder", "it slips in proportion to motion, seeded", "share lost (0.05)", is_value_needed=False),
    "frozen_clock": FaultKind("encoder", "of the whole board: reports keep one time stamp"),
    "switched_off": FaultKind(
        "motor bought roboclaw", "another program, unheard by the host, takes the drive out of operation, once"
    ),
    "switched_on": FaultKind("motor bought roboclaw", "the same, into operation to hold; with a duty, where a board cannot hold"),
    "swapped_motors": FaultKind("motor", "its node and another's are changed over", "the other node", is_built_in=True),
    "wrong_gear": FaultKind("motor", "another gear than arm.toml has", "motor turns a joint turn", is_built_in=True),
    "dead_motor": FaultKind("motor bought roboclaw", "no current flows"),
    "stuck_joint": FaultKind("motor bought roboclaw", "the joint is jammed"),
    "swapped_polarity": FaultKind("motor bought roboclaw", "a positive voltage turns it backwards"),
    "over_current": FaultKind("motor bought roboclaw", "a cause of this error, as long as the fault lasts"),
    "over_temperature": FaultKind("motor bought roboclaw", "the same"),
    "encoder_fault": FaultKind("motor", "the same"),
    "supply": FaultKind("motor bought roboclaw", "another supply", "V"),
    "says_current": FaultKind("motor", "replies have this current", "A"),
    "says_supply": FaultKind("motor", "replies have this supply", "V"),
    "says_temperature": FaultKind("motor", "replies have this temperature", "degC"),
    "e_stop": FaultKind("roboclaw", "its E-stop input is active"),
    "exchanged_bodies": FaultKind("camera", "two bodies of a motion capture system are taken for one another"),
}


def kinds_of(board: str) -> frozenset[str]:
    """What a board of this sort, a word of BOARDS, can have."""
    return frozenset(name for name, kind in KINDS.items() if board in kind.boards.split())


def fault_sections() -> list[FileSection]:
    """The kinds as tables, for `armwright arm --keys`."""
    shown: dict[str, list[Key]] = {board: [] for board in BOARDS}
    for name, kind in KINDS.items():
        words = kind.value and f"value: {kind.value}"
        for board in kind.boards.split():
            if board != "roboclaw" or "bought" not in kind.boards:
                shown[board].append(Key(name, words, "", f"{'built in: ' if kind.is_built_in else ''}{kind.text}"))
    return [FileSection("[[fault]] kind", of, tuple(shown[board])) for board, of in BOARDS.items()]


Frames = list[tuple[float, bytes]]  # (arrival time at the host, frame)


def check_fault(fault: FaultTable, boards: Sequence[str], where: str) -> None:
    """Raise ScenarioError unless the board exists and can have the fault."""
    place = f'{where}: fault "{fault.kind}"'
    if fault.board not in boards:
        raise ScenarioError(f'{place}: no board "{fault.board}"; there are {", ".join(boards)}.')
    sort = fault.board.rstrip(digits)
    kinds = kinds_of(sort if sort in BOARDS else "bought")
    if fault.kind not in kinds:
        raise ScenarioError(f"{place}: expected one of {', '.join(sorted(kinds))}.")
    kind = KINDS[fault.kind]
    if kind.is_built_in and fault.at_s > 0.0:
        raise ScenarioError(f"{place}: is wired in before power-up; at_s must be 0, got {fault.at_s:g}.")
    if kind.value and kind.is_value_needed and fault.value is None:
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
        return tuple(f for f in self.active if f.board == board and KINDS[f.kind].is_on_frames)


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
