"""The spare pins of a motor board: directions, levels and safe levels; written from docs/motor_board.md."""

from __future__ import annotations

import struct

_COMMAND = struct.Struct("<BBB5x")
_REPLY = struct.Struct("<BBBB4x")


class DigitalPinsMock:
    """Pins of one board. `outside` has the levels that the world puts on inputs; `is_enabled` is the drive's."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.outside = 0
        self._directions = self._safe_levels = self._keep = 0
        self._driven = 0
        self.is_enabled = False

    def reset(self) -> None:
        """Power-up: every pin is an input, and no level was ever set."""
        self._directions = self._safe_levels = self._keep = self._driven = 0
        self.is_enabled = False

    def configure(self, directions: int, safe_levels: int, keep: int) -> None:
        """The parameters have changed."""
        self._directions, self._safe_levels, self._keep = directions, safe_levels, keep
        self._go_safe()

    def follow(self, is_enabled: bool) -> None:
        """The drive is in OPERATION ENABLED, or not."""
        if self.is_enabled and not is_enabled:
            self._go_safe()
        self.is_enabled = is_enabled

    def command(self, payload: bytes) -> bytes:
        """Answer a DIGITAL_COMMAND."""
        sequence, mask, levels = _COMMAND.unpack(payload)
        if self.is_enabled:
            mask &= self._directions
            self._driven = self._driven & ~mask | levels & mask
        return _REPLY.pack(sequence, self.levels, self.outputs, not self.is_enabled)

    @property
    def outputs(self) -> int:
        """Levels that the board drives."""
        return self._driven & self._directions

    @property
    def levels(self) -> int:
        """Levels at the pins."""
        return self.outputs | self.outside & ~self._directions & ((1 << self.count) - 1)

    def _go_safe(self) -> None:
        self._driven = self._driven & self._keep | self._safe_levels & ~self._keep
