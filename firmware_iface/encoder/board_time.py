"""The board's u32 microseconds, which wrap after 71.6 min, as seconds that go on."""

_WRAP_us = 1 << 32
_HALF_us = 1 << 31
# A board's time can lie ahead of what the host has seen so far by the crystals' drift and by how
# late the earlier reports were read, never by a whole second; late reports lie behind, by any amount.
_AHEAD_LIMIT_us = 1_000_000


class BoardTime:
    """Unwraps the time stamps of one board, and tells a restarted board from a wrapped counter."""

    def __init__(self) -> None:
        self._last_us = 0
        self._host_us = 0
        self._furthest_ahead_us = 0
        self._has_started = False

    @property
    def seconds(self) -> float:
        """Board time of the last report [s], without wrap; starts where the board's counter stood."""
        return self._last_us * 1e-6

    def advance(self, board_time_us: int, host_s: float) -> bool:
        """Take the stamp of a report read at `host_s`. False: the board has restarted since."""
        host_us = int(host_s * 1e6)
        if not self._has_started:
            self._start(board_time_us, host_us)
            return True
        # Of all times with these low 32 bits, the one nearest to what the host's clock predicts.
        predicted_us = self._last_us + host_us - self._host_us
        now_us = predicted_us + (board_time_us - predicted_us + _HALF_us) % _WRAP_us - _HALF_us
        ahead_us = now_us - host_us
        if now_us < self._last_us or ahead_us > self._furthest_ahead_us + _AHEAD_LIMIT_us:
            self._start(board_time_us, host_us)
            return False
        self._last_us, self._host_us = now_us, host_us
        if ahead_us > self._furthest_ahead_us:
            self._furthest_ahead_us = ahead_us
        return True

    def _start(self, board_time_us: int, host_us: int) -> None:
        self._last_us, self._host_us = board_time_us, host_us
        self._furthest_ahead_us = board_time_us - host_us
        self._has_started = True
