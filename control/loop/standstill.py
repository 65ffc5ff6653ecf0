"""Detects that the arm has come to rest in its present mode; the shutdown waits for it between steps."""

from collections.abc import Sequence

STILL_S = 0.5
STILL_rad_s = 0.02  # one count of the reference arm in one cycle is 0.015 rad/s
# Shorted windings lower the reference arm from any pose within this time; its encoders may be dead.
SINK_LIMIT_S = 15.0


class Standstill:
    """Follows the joints' speeds since the mode was entered at `mode_from_s`."""

    def __init__(self) -> None:
        self.mode_from_s = 0.0
        self._still_from_s = 0.0

    def enter_mode(self, now_s: float) -> None:
        """Restart the detection because a mode was entered."""
        self.mode_from_s = self._still_from_s = now_s

    def is_still(self, now_s: float, speed_rad_s: Sequence[float]) -> bool:
        """Whether nothing has moved for a while, or so much time has passed that any arm has come to rest."""
        if now_s - self.mode_from_s > SINK_LIMIT_S:
            return True
        if any(abs(speed) > STILL_rad_s for speed in speed_rad_s):
            self._still_from_s = now_s
        return now_s - self._still_from_s >= STILL_S
