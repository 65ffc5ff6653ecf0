"""Whether the arm has come to rest in its present mode: what the way off waits for, step by step."""

from collections.abc import Sequence

STILL_S = 0.5
STILL_rad_s = 0.02  # one count of the reference arm in one cycle is 0.015 rad/s
# Shorted windings let the reference arm down from any pose within this; its encoders may be dead.
SINK_LIMIT_S = 15.0


class Standstill:
    """Follows the joints' speeds since the mode was entered at `mode_from_s`."""

    def __init__(self) -> None:
        self.mode_from_s = 0.0
        self._still_from_s = 0.0

    def enter_mode(self, now_s: float) -> None:
        """A mode was entered: what was still before says nothing of what comes."""
        self.mode_from_s = self._still_from_s = now_s

    def is_still(self, now_s: float, speed_rad_s: Sequence[float]) -> bool:
        """Whether nothing has moved for a while; by some time every arm has sunk or come to rest, seen or not."""
        if now_s - self.mode_from_s > SINK_LIMIT_S:
            return True
        if any(abs(speed) > STILL_rad_s for speed in speed_rad_s):
            self._still_from_s = now_s
        return now_s - self._still_from_s >= STILL_S
