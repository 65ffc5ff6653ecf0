"""Dialogues [(TX, …), (RX, …)] as scripts, and a clock that is turned by waiting."""

from collections.abc import Callable

from firmware_iface.errors import LinkLost

TX = "host sends"
RX = "host receives"
Script = list[tuple[str, bytes]]
FrameScript = list[tuple[str, int, bytes]]


class FakeClock:
    """Time passes only by waiting; `on_wait` is what the world does meanwhile."""

    def __init__(self, now_s: float = 100.0) -> None:
        self.time_s = now_s
        self.on_wait: Callable[[float], None] = lambda now_s: None

    def now_s(self) -> float:
        return self.time_s

    def wait_until_s(self, t: float) -> None:
        self.time_s = max(self.time_s, t)
        self.on_wait(self.time_s)


class ScriptedBytes:
    """A serial line with a script: each write must be the next TX; the RX that follow it are then there to read."""

    name = "/dev/ttyTEST"

    def __init__(self, script: Script, baud: int = 1_000_000) -> None:
        self.baud = baud
        self.script = list(script)
        self.is_lost = False
        self.incoming = b""
        self._play()

    def _play(self) -> None:
        while self.script and self.script[0][0] == RX:
            self.incoming += self.script.pop(0)[1]

    def read(self) -> bytes:
        if self.is_lost:
            raise LinkLost(f"serial port {self.name}: lost")
        received, self.incoming = self.incoming, b""
        return received

    def wait(self, limit_s: float) -> bool:
        return self.is_lost or bool(self.incoming)

    def write(self, data: bytes) -> None:
        assert self.script, f"nothing more to be sent, got {data.hex(' ')}"
        assert data == self.script.pop(0)[1]
        self._play()

    def close(self) -> None:
        self.is_lost = True

    def push(self, data: bytes) -> None:
        """Bytes that come by themselves."""
        self.incoming += data


class ScriptedFrames:
    """The same for a CAN bus."""

    name = "test:can0"

    def __init__(self, script: FrameScript) -> None:
        self.script = list(script)
        self.incoming: list[tuple[int, bytes]] = []
        self._play()

    def _play(self) -> None:
        while self.script and self.script[0][0] == RX:
            _, can_id, payload = self.script.pop(0)
            self.incoming.append((can_id, payload))

    def send(self, can_id: int, payload: bytes) -> None:
        assert self.script, f"nothing more to be sent, got {can_id:#x} {payload.hex(' ')}"
        _, expected_id, expected = self.script.pop(0)
        assert (hex(can_id), payload.hex(" ")) == (hex(expected_id), expected.hex(" "))
        self._play()

    def receive(self) -> list[tuple[int, bytes]]:
        frames, self.incoming = self.incoming, []
        return frames

    def close(self) -> None:
        self.script = []

    def push(self, can_id: int, payload: bytes) -> None:
        """A frame that comes by itself."""
        self.incoming.append((can_id, payload))
