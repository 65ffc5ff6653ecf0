"""Mock cameras: rate, clock, latency; and the one whose datagrams are those of docs/camera.md."""

from __future__ import annotations

import random
import struct
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass
from typing import Literal, Protocol

Point = tuple[float, float, float]
TipPose = tuple[Point, tuple[Point, Point, Point]]  # the tip, and the axes x, y, z of the last link


class Filmed(Protocol):
    """The arm before the camera, as it is now."""

    def tip_m(self) -> Point: ...

    def tip_pose(self) -> TipPose: ...


Transport = Literal["datagrams", "commands", "connection"]  # sent to a port; UDP commands answered; a TCP server
_FRAME = struct.Struct("<4sBBHIdddd")
_VISIBLE = 1
TIP_MARKER = 0


@dataclass(frozen=True, slots=True)
class CameraSetup:
    """Rate, noise per axis (standard deviation), latency from image to datagram, share of frames without the tip."""

    rate_Hz: float = 100.0
    noise_m: float = 0.00014
    latency_s: float = 0.0
    dropout: float = 0.0
    clock_ppm: float = 0.0
    seed: int = 0


class PictureMock(ABC):
    """Takes an image at the first tick at or after each multiple of its period, stamped with that tick's time."""

    transport: Transport = "datagrams"
    is_exchanged = False  # two bodies have each other's name

    def __init__(self, setup: CameraSetup) -> None:
        self.setup = setup
        self.random = random.Random(f"camera {setup.seed}")
        self._pictures = 0
        self._rate = 1.0 + setup.clock_ppm * 1e-6
        self._on_its_way: deque[tuple[float, bytes]] = deque()
        self.next_s = 0.0  # nothing to do before this time

    def tick(self, now_s: float, arm: Filmed) -> list[bytes]:
        """What is sent now; `arm` is looked at only when an image is due."""
        due_s = self._pictures / self.setup.rate_Hz
        if now_s >= due_s - 1e-9:
            self._pictures = int((now_s + 1e-9) * self.setup.rate_Hz) + 1
            self._on_its_way.append((now_s + self.setup.latency_s, self.picture(now_s * self._rate, arm)))
        ready = []
        while self._on_its_way and self._on_its_way[0][0] <= now_s + 1e-9:
            ready.append(self._on_its_way.popleft()[1])
        arrival_s = self._on_its_way[0][0] if self._on_its_way else float("inf")
        self.next_s = min(self._pictures / self.setup.rate_Hz, arrival_s) - 1e-9
        return ready

    @abstractmethod
    def picture(self, time_s: float, arm: Filmed) -> bytes:
        """The packet of an image at a time of the camera's clock."""

    def answer(self, request: bytes) -> list[bytes]:
        """Packets that answer one of the host."""
        return []


class CameraMock(PictureMock):
    """Sees one marker at the tip, in the base frame."""

    def __init__(self, setup: CameraSetup) -> None:
        super().__init__(setup)
        self._sequence = 0

    def picture(self, time_s: float, arm: Filmed) -> bytes:
        """One datagram."""
        source, noise_m = self.random, self.setup.noise_m
        seen = [value + source.gauss(0.0, noise_m) for value in arm.tip_m()]
        is_visible = source.random() >= self.setup.dropout
        if not is_visible:
            seen = [0.0, 0.0, 0.0]
        flags = _VISIBLE if is_visible else 0
        coded = _FRAME.pack(b"AWCM", 1, flags, TIP_MARKER, self._sequence & 0xFFFFFFFF, time_s, *seen)
        self._sequence += 1
        return coded
