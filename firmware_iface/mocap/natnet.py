"""OptiTrack's Motive by NatNet: asks the server what it is and what its bodies are called, then receives frames.

Unicast frames come to the port from which the server was asked, as long as it hears from us; multicast ones to a group's
port, which the server names. Motive's y axis points up unless its streaming settings say z.
"""

from __future__ import annotations

from collections.abc import Callable

from firmware_iface.clock import Clock
from firmware_iface.errors import BoardSilent, WrongIdentity
from firmware_iface.mocap import natnet_wire as wire
from firmware_iface.mocap.bodies import BodyFrame
from firmware_iface.udp import UdpListener

ANSWER_LIMIT_s, LOOK_s = 2.0, 0.01
KEEP_ALIVE_s = 1.0  # Motive forgets a silent client after some seconds


class NatNetStream:
    """Meets BodyStream."""

    def __init__(self, host: str, port: int, clock: Clock) -> None:
        """Ask the server. PortMissing, BoardSilent if nothing answers, WrongIdentity for a protocol that is not 3 or 4."""
        self.rejected = 0
        self._clock, self._server_port = clock, port
        self._commands = UdpListener("NatNet", 0, host)
        self._data: UdpListener | None = None
        self.name = f"natnet://{host}:{port}"
        self._server: wire.NatNetServer | None = None
        self._names: dict[int, str] | None = None
        self._frames: list[BodyFrame] = []
        self._spoke_s = clock.now_s()
        try:
            self._introduce()
        except BaseException:
            self.close()
            raise

    def _introduce(self) -> None:
        self._ask(wire.request(wire.CONNECT, "Ping"))
        if not self._wait(lambda: self._server is not None) or self._server is None:
            raise BoardSilent(
                f"{self.name}: no answer within {ANSWER_LIMIT_s:g} s; check host and port, that Motive streams"
                " (Streaming > NatNet), and its computer's firewall"
            )
        server = self._server
        if server.version < wire.OLDEST or server.version[0] > wire.NEWEST_MAJOR:
            version = ".".join(map(str, server.version))
            raise WrongIdentity(
                f"{self.name}: {server.program} speaks NatNet {version}, expected 3.0 to {wire.NEWEST_MAJOR}.x"
            )
        if server.group:
            self._data = UdpListener("NatNet", server.data_port, self._commands.sender, group=server.group)
        self._ask(wire.request(wire.REQUEST_MODELS))
        if not self._wait(lambda: self._names is not None):
            raise BoardSilent(f"{self.name}: does not say what its rigid bodies are called")

    def _wait(self, is_so: Callable[[], bool]) -> bool:
        begun_s = self._clock.now_s()
        while not is_so() and self._clock.now_s() - begun_s < ANSWER_LIMIT_s:
            self._clock.wait_until_s(self._clock.now_s() + LOOK_s)
            self._frames += self._received()
        return is_so()

    def receive(self) -> list[BodyFrame]:
        """All frames received so far; keeps the server sending, and asks for names that are not known."""
        frames, self._frames = self._frames + self._received(), []
        now_s = self._clock.now_s()
        if now_s - self._spoke_s >= KEEP_ALIVE_s:
            self._ask(wire.request(wire.KEEP_ALIVE))
            if frames and any(body.name.isdigit() for body in frames[-1].bodies):
                self._ask(wire.request(wire.REQUEST_MODELS))  # bodies that were made meanwhile
        return frames

    def _ask(self, packet: bytes) -> None:
        self._spoke_s = self._clock.now_s()
        self._commands.send(packet, self._server_port)

    def _received(self) -> list[BodyFrame]:
        found = [self._taken(packet) for packet in self._commands.datagrams()]
        if self._data is not None:
            found += [self._taken(packet) for packet in self._data.datagrams()]
        return [frame for frame in found if frame is not None]

    def _taken(self, packet: bytes) -> BodyFrame | None:
        """Act on a packet; returns the frame if it is one. What cannot be read is counted."""
        message, payload = wire.message_of(packet) or (None, b"")
        if message == wire.SERVER_INFO and (server := wire.unpack_server(payload)) is not None:
            self._server = server
        elif message == wire.MODELS and self._server is not None:
            names = wire.unpack_models(payload, self._server.version)
            self.rejected += names is None
            self._names = self._names if names is None else names
        elif message == wire.FRAME and self._server is not None and self._names is not None:
            frame = wire.unpack_frame(payload, self._server.version, self._names)
            self.rejected += frame is None
            return frame
        elif message is None:
            self.rejected += 1
        return None

    def close(self) -> None:
        """End the stream."""
        self._commands.close()
        if self._data is not None:
            self._data.close()
