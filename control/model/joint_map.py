"""Conversion between counts of an encoder and radians of its joint, with counter unwrapping."""

import math

from control.errors import BadTarget
from control.model.arm import Drive


class JointMap:
    """Counts to joint angle and back: ratio, counts per turn, direction, and the count at zero.

    `angle = direction (count - zero_count) 2 pi / (counts_per_rev turns)`; counts are unwrapped ones, `turns` those of the
    encoder per turn of the joint: `gear_ratio` of one on the motor, 1 of one on the joint.
    """

    __slots__ = ("counts_per_radian", "radians_per_count", "zero_count")

    def __init__(self, drive: Drive) -> None:
        counts_per_turn = drive.counts_per_joint_turn * drive.encoder_direction
        self.counts_per_radian = counts_per_turn / (2.0 * math.pi)  # signed by the encoder's direction
        self.radians_per_count = (2.0 * math.pi) / counts_per_turn
        self.zero_count = drive.zero_count

    def radians(self, count: float) -> float:
        """Return the joint angle at an unwrapped count."""
        return (count - self.zero_count) * self.radians_per_count

    def count(self, q_rad: float) -> int:
        """Return the nearest unwrapped count of a joint angle."""
        try:
            return round(q_rad * self.counts_per_radian) + self.zero_count
        except (ValueError, OverflowError):
            raise BadTarget(f"joint angle: expected a finite number, got {q_rad}") from None


class Unwrapper:
    """Unwraps a counter of `bits` bits; steps must be below half of its range.

    The first count is the reference: `start` unwraps to itself.
    """

    __slots__ = ("_half", "_mask", "unwrapped_count")

    def __init__(self, bits: int, start: int) -> None:
        self._mask = (1 << bits) - 1
        self._half = 1 << (bits - 1)
        self.unwrapped_count = start

    def update(self, raw_count: int) -> int:
        """Return the unwrapped count of the latest raw one, signed or unsigned."""
        step = (raw_count - self.unwrapped_count + self._half & self._mask) - self._half
        self.unwrapped_count += step
        return self.unwrapped_count
