"""A runtime in the client's own process: waiting runs cycles. For stepped simulations, tests and benchmarks."""

from typing import Any, Protocol

import msgspec

from control.hardware.connect import AttendedClock
from control.loop.cell import Looped
from control.server.channel import Message, RuntimeGone
from control.server.messages import Asked, asked
from control.server.scheduling import PeriodicTimer
from control.server.server import encoded
from firmware_iface.clock import Clock


class Served(Protocol):
    """A runtime, of one arm or of several, and the server of its requests."""

    @property
    def runtime(self) -> Looped: ...

    @property
    def requests(self) -> "Handling": ...


class Handling(Protocol):
    """Serves requests."""

    def handle(self, request: Asked, client: int) -> Message: ...

    def on_gone(self, client: int) -> None: ...


class SteppedLoop:
    """The loop of a runtime whose clock runs only while a client waits."""

    def __init__(self, served: Served, clock: Clock) -> None:
        self.cycles = 0
        self.is_running = True
        self._served = served
        self._clock = clock
        self._beat = PeriodicTimer(AttendedClock(clock, served.runtime), served.runtime.period_s)

    def request(self, message: Message, client: int, arm: str) -> Message:
        """Serve a request at once, between two cycles. RuntimeGone after the last one, as over the socket."""
        if not self.is_running:
            raise RuntimeGone("the runtime has ended")
        request = asked(msgspec.json.encode(message))
        answer = self._served.requests.handle(request._replace(arm=request.arm or arm), client)
        if self._served.runtime.ended_wait(self._clock.now_s()):
            self._beat.restart()
        decoded: dict[str, Any] = msgspec.json.decode(encoded(answer))
        return decoded

    def run(self, duration_s: float) -> None:
        """Run cycles for `duration_s` of the clock, or until the runtime ends."""
        end_s = self._clock.now_s() + duration_s
        beat, runtime = self._beat, self._served.runtime
        while self.is_running and self._clock.now_s() < end_s - 1e-9:
            late_s = beat.wait()
            self.is_running = runtime.cycle(self._clock.now_s(), late_s, beat.skipped, beat.missed_in_row)
            self.cycles += 1

    def gone(self, client: int) -> None:
        """A client disconnects."""
        self._served.requests.on_gone(client)


class InProcessChannel:
    """A `control.server.client.Channel` to a runtime in this process.

    Requests go through the same JSON as over the socket, so both behave alike. `loop`: that of another channel to the same
    runtime, with its number and arm.
    """

    def __init__(self, served: Served, clock: Clock, loop: SteppedLoop | None = None, number: int = 0, arm: str = "") -> None:
        self.loop = loop or SteppedLoop(served, clock)
        self._number, self._arm = number, arm

    @property
    def cycles(self) -> int:
        """Cycles since the start."""
        return self.loop.cycles

    @property
    def is_running(self) -> bool:
        """Whether the runtime has not ended."""
        return self.loop.is_running

    def request(self, message: Message) -> Message:
        """Serve the request at once, between two cycles."""
        return self.loop.request(message, self._number, self._arm)

    def wait(self, duration_s: float) -> None:
        """Run cycles for `duration_s` of the clock, or until the runtime ends."""
        self.loop.run(duration_s)

    def close(self) -> None:
        """Disconnect: a motion that this client started is stopped."""
        self.loop.gone(self._number)
