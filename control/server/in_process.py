"""A runtime in the client's own process: waiting runs cycles. For stepped simulations, tests and benchmarks."""

from typing import Any

import msgspec

from control.hardware.attended_clock import AttendedClock
from control.server.assemble import Assembly
from control.server.client import Message
from control.server.messages import asked
from control.server.periodic import PeriodicTimer
from control.server.server import encoded
from firmware_iface.clock import Clock


class InProcessChannel:
    """A `control.server.client.Channel` to a runtime whose clock runs only while a client waits.

    Requests go through the same JSON as over the socket, so both behave alike.
    """

    def __init__(self, assembly: Assembly, clock: Clock) -> None:
        self.cycles = 0
        self._assembly = assembly
        self._clock = clock
        parts = assembly.runtime.parts
        self._beat = PeriodicTimer(AttendedClock(clock, parts.hardware), parts.period_s)
        self.is_running = True

    def request(self, message: Message) -> Message:
        """Serve the request at once, between two cycles."""
        runtime = self._assembly.runtime
        answer = self._assembly.requests.handle(asked(msgspec.json.encode(message)), 0)
        if runtime.ended_wait(self._clock.now_s()):
            self._beat.restart()
        decoded: dict[str, Any] = msgspec.json.decode(encoded(answer))
        return decoded

    def wait(self, duration_s: float) -> None:
        """Run cycles for `duration_s` of the clock, or until the runtime ends."""
        end_s = self._clock.now_s() + duration_s
        beat, runtime = self._beat, self._assembly.runtime
        while self.is_running and self._clock.now_s() < end_s - 1e-9:
            late_s = beat.wait()
            self.is_running = runtime.cycle(self._clock.now_s(), late_s, beat.skipped, beat.missed_in_row)
            self.cycles += 1

    def close(self) -> None:
        """Disconnect: a motion that this client started is stopped."""
        self._assembly.requests.on_gone(0)
