"""Unwraps the board's u32 microsecond counter, which wraps after 71.6 min, to continuous seconds, and tells late reports."""

_WRAP_us = 1 << 32
_HALF_us = 1 << 31
# A board's time can lead the host's estimate by the drift of the crystals and by how
# late earlier reports were read, never by a whole second. Late reports may lag by any amount.
_AHEAD_LIMIT_us = 1_000_000
# The first reports may have waited for a host that was busy with its start: then the next ones lead by as much.
_AHEAD_LIMIT_AT_FIRST_us = 60_000_000
_AT_FIRST_us = 5_000_000
_DRIFT = 3e-4  # two crystals differ by less; a board whose clock falls back faster sends old counts


class BoardTime:
    """Unwraps the time stamps of one board and distinguishes a restart from a wrap."""

    def __init__(self) -> None:
        self._last_us = 0
        self._host_us = 0
        self._started_us = 0  # on the host's clock
        self._furthest_ahead_us = 0
        self._prompt_ahead_us = 0.0  # lead over the host's time in a report without delay
        self._has_started = False

    @property
    def seconds(self) -> float:
        """Unwrapped board time of the last report [s]; starts at the board's first counter value."""
        return self._last_us * 1e-6

    @property
    def lag_s(self) -> float:
        """How much later the last report was read, after it was made, than a prompt one [s]."""
        return (self._prompt_ahead_us - (self._last_us - self._host_us)) * 1e-6

    def advance(self, board_time_us: int, host_s: float) -> bool:
        """Process the time stamp of a report read at `host_s`. Returns False if the board has restarted."""
        host_us = int(host_s * 1e6)
        if not self._has_started:
            self._start(board_time_us, host_us)
            return True
        # Of all times with these low 32 bits, the one nearest to what the host's clock predicts.
        predicted_us = self._last_us + host_us - self._host_us
        now_us = predicted_us + (board_time_us - predicted_us + _HALF_us) % _WRAP_us - _HALF_us
        ahead_us = now_us - host_us
        is_early = host_us - self._started_us < _AT_FIRST_us
        limit_us = _AHEAD_LIMIT_AT_FIRST_us if is_early else _AHEAD_LIMIT_us
        if now_us < self._last_us or ahead_us > self._furthest_ahead_us + limit_us:
            self._start(board_time_us, host_us)
            return False
        self._prompt_ahead_us = max(self._prompt_ahead_us - _DRIFT * (host_us - self._host_us), ahead_us)
        self._last_us, self._host_us = now_us, host_us
        if ahead_us > self._furthest_ahead_us:
            self._furthest_ahead_us = ahead_us
        return True

    def _start(self, board_time_us: int, host_us: int) -> None:
        self._last_us, self._host_us = board_time_us, host_us
        self._started_us = host_us
        self._furthest_ahead_us = board_time_us - host_us
        self._prompt_ahead_us = self._furthest_ahead_us
        self._has_started = True
