"""Qualisys Track Manager by its real-time protocol over TCP: version, names of the bodies, then every frame."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable

from firmware_iface.clock import Clock
from firmware_iface.errors import BoardSilent, LinkLost, PortMissing, WrongIdentity
from firmware_iface.mocap import qtm_wire as wire
from firmware_iface.mocap.bodies import BodyFrame
from firmware_iface.mocap.fields import Malformed

VERSION = "1.19"  # QTM of 2018; later ones speak it, too
CONNECT_LIMIT_s, ANSWER_LIMIT_s, LOOK_s = 2.0, 3.0, 0.01
_PART_bytes = 65536


class QtmStream:
    """Meets BodyStream."""

    def __init__(self, host: str, port: int, clock: Clock) -> None:
        """Connect and start the stream. PortMissing, BoardSilent, WrongIdentity (QTM refuses) or LinkLost."""
        self.rejected = 0
        self.name = f"qtm://{host}:{port}"
        self._clock, self._packets = clock, wire.Packets()
        self._said: list[str] = []
        self._names: list[tuple[str, bool]] | None = None
        self._frames: list[BodyFrame] = []
        try:
            self._socket = socket.create_connection((host, port), CONNECT_LIMIT_s)
        except OSError as problem:
            raise PortMissing(
                f"{self.name}: cannot connect: {problem}; check host and port, that QTM runs, and its computer's firewall"
            ) from None
        self._socket.setblocking(False)
        try:
            self._introduce()
        except BaseException:
            self.close()
            raise

    def _introduce(self) -> None:
        self._expect("connected", "greeting")
        self._send(f"Version {VERSION}")
        self._expect("version set", "answer to the version")
        self._send("GetParameters 6D")
        self._until(lambda: self._names is not None, "names of its 6D bodies")
        self._send("StreamFrames AllFrames 6DRes")

    def _expect(self, word: str, what: str) -> None:
        self._until(lambda: any(word in said.lower() for said in self._said), what)
        self._said.clear()

    def _until(self, is_so: Callable[[], bool], what: str) -> None:
        begun_s = self._clock.now_s()
        while not is_so():
            if self._clock.now_s() - begun_s >= ANSWER_LIMIT_s:
                raise BoardSilent(f"{self.name}: no {what} within {ANSWER_LIMIT_s:g} s: is it QTM's port?")
            self._clock.wait_until_s(self._clock.now_s() + LOOK_s)
            self._frames += self._received()

    def receive(self) -> list[BodyFrame]:
        """All frames received so far. LinkLost if QTM has closed the connection."""
        frames, self._frames = self._frames + self._received(), []
        return frames

    def close(self) -> None:
        """End the stream."""
        with contextlib.suppress(OSError, LinkLost):
            self._send("StreamFrames Stop")
        self._socket.close()

    def _send(self, text: str) -> None:
        try:
            self._socket.sendall(wire.command(text))
        except OSError as problem:
            raise LinkLost(f"{self.name}: lost: {problem}") from None

    def _received(self) -> list[BodyFrame]:
        found: list[BodyFrame] = []
        while (part := self._part()) is not None:
            try:
                packets = self._packets.feed(part)
            except Malformed:
                raise LinkLost(
                    f"{self.name}: sends packets of impossible sizes: is it QTM's little-endian port?"
                ) from None
            found += [frame for kind, content in packets if (frame := self._taken(kind, content)) is not None]
        return found

    def _part(self) -> bytes | None:
        try:
            part = self._socket.recv(_PART_bytes)
        except BlockingIOError:
            return None
        except OSError as problem:
            raise LinkLost(f"{self.name}: lost: {problem}") from None
        if not part:
            raise LinkLost(f"{self.name}: QTM has closed the connection")
        return part

    def _taken(self, kind: int, content: bytes) -> BodyFrame | None:
        """Act on a packet; returns the frame if it is one."""
        if kind == wire.DATA and self._names is not None:
            frame = wire.unpack_data(content, self._names)
            self.rejected += frame is None
            return frame
        if kind == wire.XML:
            names = wire.unpack_names(content)
            self.rejected += names is None
            self._names = self._names if names is None else names
        elif kind == wire.COMMAND:
            self._said.append(wire.text_of(content))
        elif kind == wire.ERROR:
            raise WrongIdentity(f"{self.name}: QTM refuses: {wire.text_of(content)}")
        return None
